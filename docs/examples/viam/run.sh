#!/bin/sh
# Started by viam-server; the environment beside it has tactile-cell and viam-sdk.
cd "$(dirname "$0")" && exec .venv/bin/python tactile_gripper.py "$@"
