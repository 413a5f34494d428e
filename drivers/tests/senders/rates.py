"""Checks the rates of the senders against a simulated clock. Exits with 1 and an AssertionError if one is wrong."""

import types

import joint_sender
import ros2_joints

PERIOD_SECS = 1 / 500
SECS = 10


class Clock:
    """Stands in for the module time."""

    def __init__(self):
        self.secs = 100.0

    def monotonic(self):
        return self.secs

    def sleep(self, secs):
        assert secs >= 0, secs
        self.secs += secs


class Counter:
    """Stands in for JointSender."""

    def __init__(self):
        self.n_by_names = {}

    def send(self, names, *_state):
        self.n_by_names[names] = self.n_by_names.get(names, 0) + 1


def check_relay():
    clock = Clock()
    counter = Counter()
    relay = ros2_joints.Relay(counter, 100, False)
    joint_sender.time = clock
    stamp = types.SimpleNamespace(sec=0, nanosec=0)
    for _ in range(round(SECS / PERIOD_SECS)):
        for names in (["joint1", "joint2"], ["finger"]):
            state = types.SimpleNamespace(name=names, position=[], velocity=[], effort=[])
            state.header = types.SimpleNamespace(stamp=stamp)
            relay.on_state(state)
        clock.secs += PERIOD_SECS
    # Each set of joints has the whole rate.
    for names in (("joint1", "joint2"), ("finger",)):
        assert abs(counter.n_by_names[names] - 100 * SECS) <= 1, counter.n_by_names


def check_ticks():
    clock = Clock()
    joint_sender.time = clock
    start_secs = clock.secs
    times_secs = []
    for _ in joint_sender.ticks(100):
        times_secs.append(clock.secs)
        # One reading is slow, and the ticks that it misses are left out.
        clock.secs += 0.05 if len(times_secs) == 500 else 0.001
        if len(times_secs) == 1000:
            break
    assert abs(times_secs[499] - start_secs - 4.99) < 1e-6, times_secs[499]
    assert abs(times_secs[500] - times_secs[499] - 0.05) < 1e-6, times_secs[500]
    assert abs(times_secs[999] - times_secs[500] - 4.99) < 1e-6, times_secs[999]


check_relay()
check_ticks()
