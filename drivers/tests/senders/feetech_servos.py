"""Emulates the STS3215 servos of an SO-101 on a pseudo terminal: python3 feetech_servos.py CALIBRATION.json

Prints the path of the terminal. Protocol: "SMS/STS/SCS communication protocol" by Feetech. The arm stands in one pose.
"""

import json
import os
import pty
import sys
import tty

POSITIONS = [2048, 1024, 3000, 2100, 2047, 2500]
MODEL_STS3215 = 777
PING, READ, SYNC_READ = 0x01, 0x02, 0x82


def registers(entry, position):
    """Memory of one servo."""
    memory = bytearray(256)

    def put(address, value):
        memory[address : address + 2] = value.to_bytes(2, "little")

    memory[0:2] = bytes([3, 10])  # firmware
    put(3, MODEL_STS3215)
    memory[5] = entry["id"]
    put(9, entry["range_min"])
    put(11, entry["range_max"])
    offset = entry["homing_offset"]  # sign in bit 11
    put(31, abs(offset) | (0x800 if offset < 0 else 0))
    put(56, position)
    return memory


def reply(servo_id, data):
    body = bytes([servo_id, len(data) + 2, 0]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def answers(servos, target, instruction, parameters):
    if instruction == PING and target in servos:
        return reply(target, b"")
    if instruction == READ and target in servos:
        address, n = parameters
        return reply(target, bytes(servos[target][address : address + n]))
    if instruction == SYNC_READ:
        address, n = parameters[:2]
        return b"".join(reply(ix, bytes(servos[ix][address : address + n])) for ix in parameters[2:] if ix in servos)
    return b""


def main():
    with open(sys.argv[1]) as file:
        entries = json.load(file).values()
    servos = {entry["id"]: registers(entry, POSITIONS[entry["id"] - 1]) for entry in entries}
    controller, terminal = pty.openpty()
    tty.setraw(terminal)
    print(os.ttyname(terminal), flush=True)
    received = b""
    while True:
        received += os.read(controller, 4096)
        while len(received) >= 4 and len(received) >= 4 + received[3]:
            packet, received = received[: 4 + received[3]], received[4 + received[3] :]
            assert packet[:2] == b"\xff\xff", packet
            os.write(controller, answers(servos, packet[2], packet[4], packet[5:-1]))


main()
