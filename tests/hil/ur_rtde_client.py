"""A client with ur_rtde: reads states of a controller for a while; prints one JSON object.

usage: ur_rtde_client.py HOST N_STATES      ur_rtde always uses port 30004
"""

import json
import sys
import time

import rtde_receive

# The variables that the driver of fieldrig reads, as far as ur_rtde has functions for them.
VARIABLES = [
    "timestamp", "actual_q", "actual_qd", "target_q", "actual_TCP_pose", "robot_mode", "safety_mode", "runtime_state",
    "robot_status_bits", "safety_status_bits", "output_int_register_24",
]


def main(host: str, n_states: int) -> None:
    client = rtde_receive.RTDEReceiveInterface(host, 500.0, VARIABLES)
    states = []
    deadline = time.monotonic() + 60
    while len(states) < n_states and time.monotonic() < deadline:
        stamp = client.getTimestamp()
        if not states or stamp > states[-1]["timestamp"]:
            states.append({"timestamp": stamp, "q": client.getActualQ(), "tcp": client.getActualTCPPose()})
        time.sleep(0.0005)
    print(json.dumps({
        "states": states,
        "qd": client.getActualQd(),
        "target_q": client.getTargetQ(),
        "robot_mode": client.getRobotMode(),
        "safety_mode": client.getSafetyMode(),
        "runtime_state": client.getRuntimeState(),
        "status_bits": client.getRobotStatus(),
        "is_connected": client.isConnected(),
    }))
    client.disconnect()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
