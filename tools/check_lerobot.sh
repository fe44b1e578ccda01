#!/bin/sh
# Makes an environment with LeRobot and checks mjstack.adapters.lerobot in it: its tests, then tools/check_lerobot.py.
# Some 6 GB, with torch's CUDA libraries; half an hour on two cores. PYTHON names a Python 3.12 or 3.13.
set -eu
cd "$(dirname "$0")/.."
venv=build/lerobot/venv
if ! test -e "$venv/.installed"; then
    python=${PYTHON:-python3.12}
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 12))' || {
        echo "PYTHON=$python: expected Python 3.12 or 3.13, which LeRobot needs. Name one: make test-lerobot PYTHON=python3.12" >&2
        exit 2
    }
    mkdir -p build/lerobot
    "$python" -m venv "$venv"
    printf '%s\n' 'numpy<2.3' 'torch<2.12' 'pillow<13' 'packaging<26' > build/lerobot/constraints.txt
    "$venv/bin/python" -m pip install --quiet --constraint build/lerobot/constraints.txt \
        --editable '.[lerobot,video,web]' 'lerobot[deepdiff-dep]' onnx pytest
    touch "$venv/.installed"
fi
PATH="$PWD/$venv/bin:$PATH"
export PATH HF_HUB_OFFLINE=1 HF_HOME="$PWD/build/lerobot/hf" MPLBACKEND=agg
python -m pytest -q tests/drivers/test_lerobot.py
exec python tools/check_lerobot.py "$@"
