#!/usr/bin/env python3
"""Opens many idle connections to a running server on this computer and measures how long a new viewer waits.

    scripts/load-server.py 127.0.0.1:7007

Opens 2000 connections with an incomplete request, 500 WebSockets that never send a message, and 32 that never read. Then connects ten
times like a browser: opens the page and a WebSocket, and requests a picture. Exits with 1 if a viewer waits more than a second to connect.
"""

import argparse
import base64
import json
import os
import resource
import socket
import struct
import sys
import time

MAX_WAIT_SECS = 1.0
N_VIEWERS = 10
UPGRADE = (
    "GET /ws HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


def connect(address):
    stream = socket.create_connection(address, timeout=10)
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return stream


def open_useless(address, n, request):
    streams = []
    for _ in range(n):
        try:
            stream = connect(address)
            stream.sendall(request.encode())
            streams.append(stream)
        except OSError:
            pass  # The server may close a connection before the request is sent.
    return streams


def send_text(stream, message):
    payload, mask = json.dumps(message).encode(), os.urandom(4)
    length = struct.pack("!B", 0x80 | len(payload)) if len(payload) < 126 else struct.pack("!BH", 0x80 | 126, len(payload))
    masked = bytes(byte ^ mask[ix % 4] for ix, byte in enumerate(payload))
    stream.sendall(b"\x81" + length + mask + masked)


def read_exactly(stream, n):
    data = b""
    while len(data) < n:
        part = stream.recv(n - len(data))
        if not part:
            raise OSError("the server closed the connection")
        data += part
    return data


def read_frame(stream):
    """Returns opcode and payload of the next WebSocket frame."""
    first, length = read_exactly(stream, 2)
    if length == 126:
        (length,) = struct.unpack("!H", read_exactly(stream, 2))
    elif length == 127:
        (length,) = struct.unpack("!Q", read_exactly(stream, 8))
    return first & 15, read_exactly(stream, length)


def view(address):
    """Connects like a browser. Returns the WebSocket, and the seconds until `hello` and until a picture or an error."""
    begun = time.monotonic()
    page = connect(address)
    page.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    if not read_exactly(page, 15).startswith(b"HTTP/1.1 200"):
        raise OSError("the page is not served")
    page.close()
    stream = connect(address)
    stream.sendall(UPGRADE.encode())
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        head += read_exactly(stream, 1)
    if not head.startswith(b"HTTP/1.1 101"):
        raise OSError(head.split(b"\r\n")[0].decode())
    send_text(stream, {"type": "ping", "t": 0.0})
    send_text(
        stream,
        {
            "type": "render", "id": 1, "size_px": [320, 240], "stages": [1.0],
            "world_from_camera": [1, 0, 0, 0.5, 0, -1, 0, 0, 0, 0, -1, 0.6, 0, 0, 0, 1],
            "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9},
        },
    )
    connected = answered = None
    while answered is None:
        opcode, payload = read_frame(stream)
        if opcode == 1:
            message = json.loads(payload)
            if message["type"] == "hello":
                connected = time.monotonic() - begun
            elif message["type"] == "error" and message["id"] == 1:
                answered = time.monotonic() - begun
        elif opcode == 2 and b'"picture"' in payload[:64]:
            answered = time.monotonic() - begun
        elif opcode == 8:
            raise OSError("the server closed the connection")
    return stream, connected, answered


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="host and port of the server, a loopback address")
    host, _, port = parser.parse_args().address.rpartition(":")
    if not host.startswith("127.") and host != "localhost":
        parser.error("the server must be on this computer (localhost or 127.*)")
    address = (host, int(port))
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))

    useless = open_useless(address, 2000, "GET / HTTP/1.1\r\nHost: loc")
    useless += open_useless(address, 500, UPGRADE)
    never_reading = open_useless(address, 32, UPGRADE)
    print(f"{len(useless)} idle connections and {len(never_reading)} clients that never read")
    viewers, waits, pictures = [], [], []
    for _ in range(N_VIEWERS):
        for stream in never_reading:
            try:
                send_text(stream, {"type": "ping", "t": 0.0})
            except OSError:
                pass  # Disconnected, as expected.
        try:
            stream, connected, answered = view(address)
        except OSError as error:
            sys.exit(f"a new viewer was rejected: {error}")
        viewers.append(stream)
        waits.append(connected)
        pictures.append(answered)
        time.sleep(0.3)
    print(f"new viewers connected within {max(waits) * 1e3:.0f} ms")
    print(f"first pictures arrived within {max(pictures) * 1e3:.0f} ms")
    if max(waits) > MAX_WAIT_SECS:
        sys.exit(f"a new viewer waited {max(waits):.2f} s, longer than {MAX_WAIT_SECS} s")


if __name__ == "__main__":
    main()
