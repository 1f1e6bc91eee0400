#!/bin/sh
# make_venv.sh FOLDER [VERSION]: a virtual environment of a Python this project runs on, or of one version such as 3.12.
# make_venv.sh --drop-broken FOLDER: take away one that was moved, or whose interpreter has gone.
set -eu

wanted=${2:-}
[ "$1" = --drop-broken ] && wanted=

fits() {
    "$1" -c 'import sys, venv, ensurepip; here = sys.version_info[:2]
wanted = tuple(int(part) for part in sys.argv[1].split(".")) if sys.argv[1] else here
sys.exit(not (here == wanted and (3, 11) <= here <= (3, 13)))' "$wanted" 2>/dev/null
}

# pip's own script names the interpreter it was made for, which lies elsewhere after a move.
works() {
    made_for=$(sed -n 's|^[^/]*\(/.*\)/bin/python.*|\1/bin|p' "$1/bin/pip" 2>/dev/null | head -n 1)
    [ -n "$made_for" ] && [ "$made_for" -ef "$1/bin" ] && fits "$1/bin/python"
}

if [ "$1" = --drop-broken ]; then
    if [ -f "$2/pyvenv.cfg" ] && ! works "$2"; then
        echo "$2 no longer works here and is made again" >&2
        rm -rf "$2"
    fi
    exit 0
fi

venv=$1
if [ -e "$venv" ] && works "$venv"; then exit 0; fi
if [ -e "$venv" ]; then
    echo "$venv exists and is not a virtual environment; move it away, then run make again" >&2
    exit 1
fi
for python in ${PYTHON:-} python3 python3.12 python3.13 python3.11 python /usr/bin/python3 /usr/local/bin/python3 \
        "$HOME"/.pyenv/versions/3.*/bin/python3; do
    if command -v "$python" >/dev/null 2>&1 && fits "$python"; then
        echo "Making $venv with $("$python" --version)"
        exec "$python" -m venv "$venv"
    fi
done
echo "No Python ${wanted:-3.11, 3.12 or 3.13} with its venv module was found; install one (Debian, Ubuntu:" \
    'apt install python3 python3-venv) or name yours: make PYTHON=/path/to/python3.12' >&2
exit 1
