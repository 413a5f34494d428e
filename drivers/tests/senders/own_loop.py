"""A control loop that sends its joint states, as in the documentation of the module."""

from joint_sender import JointSender, arguments, ticks

args = arguments("test", rate_hz=200).parse_args()
sender = JointSender(args.to)
for _ in ticks(args.rate):
    sender.send(["b", "a"], [0.2, 0.1], effort=[2.0, 1.0])
