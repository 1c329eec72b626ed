#!/bin/sh
# The `rtugate` command of a board that has the sources.
export PYTHONPATH=/usr/share/rtugate RUNTIME_DIRECTORY=/run/rtugate
exec /usr/bin/python3 -m gateway "$@"
