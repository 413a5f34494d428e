#!/bin/sh
# Checks the rig and the port of `make demo` before the build, which takes minutes. Otherwise fails with one sentence.
#
# usage: check-demo.sh RIG_FILE PORT
set -eu
cd "$(dirname "$0")/.."
rig=$1
port=$2

if [ ! -f "$rig" ]; then
    names=$(cd rigs && ls ./*.toml | sed 's#^\./##; s#\.toml$##' | tr '\n' ' ')
    echo "make demo: there is no rig file $rig; RIG is the path of a rig file (.toml), or one of: ${names% }" >&2
    exit 1
fi

case "$port" in
'' | 0* | *[!0-9]* | ??????*)
    echo "make demo: PORT=$port is not a port; give a number from 1 to 65535" >&2
    exit 1
    ;;
esac
if [ "$port" -gt 65535 ]; then
    echo "make demo: PORT=$port is not a port; give a number from 1 to 65535" >&2
    exit 1
fi

# is_used PORT: whether a program listens on the port at 127.0.0.1, or at all addresses. The kernel lists sockets as ADDRESS:PORT in
# hexadecimal digits, with the bytes of each address word reversed, and the state 0A for listening ones.
is_used() {
    cat /proc/net/tcp /proc/net/tcp6 2>/dev/null |
        awk -v end=":$(printf %04X "$1")" '
            $4 == "0A" && $2 ~ end "$" && ($2 ~ /^0100007F:/ || $2 ~ /^0+:/ || $2 ~ /^0000000000000000FFFF00000100007F:/) { used = 1 }
            END { exit !used }'
}

if is_used "$port"; then
    free=$((port + 1))
    while [ "$free" -le 65535 ] && is_used "$free"; do
        free=$((free + 1))
    done
    echo "make demo: another program uses port $port; run: make demo PORT=$free" >&2
    exit 1
fi
