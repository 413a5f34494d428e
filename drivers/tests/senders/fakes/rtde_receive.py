"""The part of ur_rtde that ur_joints.py uses. The controller runs at 125 Hz and moves one joint."""

import time


class RTDEReceiveInterface:
    def __init__(self, hostname, frequency, variables):
        if hostname != "127.0.0.2":
            raise RuntimeError("read_some: Connection refused")
        assert frequency == 125.0, frequency
        assert variables == ["timestamp", "actual_q", "actual_qd"], variables
        self._start = time.monotonic()

    def isConnected(self):
        return True

    def getTimestamp(self):
        return 1000.0 + int((time.monotonic() - self._start) * 125) / 125

    def getActualQ(self):
        return [0.1 * ix - 0.2 for ix in range(6)]

    def getActualQd(self):
        return [0.01 * ix for ix in range(6)]
