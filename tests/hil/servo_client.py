"""A client of the makers' libraries: finds servos, reads them together, and moves them; prints one JSON object.

usage: servo_client.py feetech|dynamixel PORT ID...
"""

import json
import sys
import time

BAUD_HZ = 1_000_000
LIMIT_SECS = 30.0
BY_COUNTS = 150


class Feetech:
    """Feetech's scservo_sdk. Addresses are those of an STS3215."""

    TORQUE, GOAL, POSITION, SIZE = 40, 42, 56, 2

    def __init__(self, port):
        import scservo_sdk as sdk

        self.sdk = sdk
        self.port = sdk.PortHandler(port)
        self.packets = sdk.PacketHandler(0)

    def reader(self, ids):
        group = self.sdk.GroupSyncRead(self.port, self.packets, self.POSITION, self.SIZE)
        return group, [group.addParam(ident) for ident in ids]

    def writer(self):
        return self.sdk.GroupSyncWrite(self.port, self.packets, self.GOAL, self.SIZE)

    def read(self, group):
        return group.txRxPacket()


class Dynamixel(Feetech):
    """ROBOTIS's dynamixel_sdk, with fast sync reads. Addresses are those of an XL430."""

    TORQUE, GOAL, POSITION, SIZE = 64, 116, 132, 4

    def __init__(self, port):
        import dynamixel_sdk as sdk

        self.sdk = sdk
        self.port = sdk.PortHandler(port)
        self.packets = sdk.PacketHandler(2.0)

    def read(self, group):
        # Both kinds of sync reads are used in turn.
        self.is_fast = not getattr(self, "is_fast", False)
        return group.fastSyncRead() if self.is_fast else group.txRxPacket()


def retry(call, is_good):
    """Repeats a call until its result is good. The libraries wait only 34 ms, which is short for a busy computer."""
    for _ in range(50):
        result = call()
        if is_good(result):
            return result
    raise RuntimeError(f"failed: {result}")


def main():
    kind, port, *ids = sys.argv[1:]
    ids = [int(ident) for ident in ids]
    client = {"feetech": Feetech, "dynamixel": Dynamixel}[kind](port)
    assert client.port.openPort() and client.port.setBaudRate(BAUD_HZ)
    models = []
    for ident in ids:
        model, _, _ = retry(lambda: client.packets.ping(client.port, ident), lambda answer: answer[1:] == (0, 0))
        models.append(model)
    _, absent, _ = client.packets.ping(client.port, 100)
    group, _ = client.reader(ids)

    def positions():
        retry(lambda: client.read(group), lambda result: result == 0)
        return [group.getData(ident, client.POSITION, client.SIZE) for ident in ids]

    start = positions()
    goals = [position + BY_COUNTS for position in start]
    for ident in ids:
        retry(
            lambda: client.packets.write1ByteTxRx(client.port, ident, client.TORQUE, 1),
            lambda answer: answer == (0, 0),
        )
    writer = client.writer()
    for ident, goal in zip(ids, goals):
        writer.addParam(ident, list(goal.to_bytes(client.SIZE, "little")))
    assert writer.txPacket() == 0
    deadline = time.monotonic() + LIMIT_SECS
    reads = 0
    while any(abs(at - goal) > 1 for at, goal in zip(positions(), goals)):
        reads += 1
        assert time.monotonic() < deadline, "the servos did not arrive"
    client.port.closePort()
    print(json.dumps({"models": models, "absent": absent, "start": start, "reads": reads}))


main()
