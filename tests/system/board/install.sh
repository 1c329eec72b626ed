#!/bin/sh
# Installs rtugate on a virtual board from the sources that lie beside this file.
set -eu
useradd --system --home-dir /var/lib/rtugate --no-create-home rtugate
install -d /usr/share/rtugate /etc/rtugate
cp -r gateway /usr/share/rtugate/
python3 -m compileall -q /usr/share/rtugate
install -m 755 rtugate.sh /usr/bin/rtugate
install -m 644 rtugate.service /etc/systemd/system/rtugate.service
install -m 644 rtugate.rules /etc/udev/rules.d/60-rtugate.rules
udevadm control --reload
udevadm trigger --settle --name-match=/dev/watchdog --name-match=/dev/watchdog0
systemctl daemon-reload
systemctl --quiet enable rtugate.service
