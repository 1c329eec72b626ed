#!/bin/sh
# Carries out what the test orders, on a port of its own. It comes and says "hello BOOT"; then an order is a line "TAG
# SCRIPT", its answer "TAG CODE OUTPUT"; SCRIPT and OUTPUT in base64.
exec 3<>/dev/virtio-ports/board.agent
printf '\nhello %s\n' "$(cat /proc/sys/kernel/random/boot_id)" >&3
while read -r tag script <&3; do
    printf %s "$script" | base64 -d >/run/board-agent.order
    sh /run/board-agent.order >/run/board-agent.output 2>&1 </dev/null 3>&-
    printf '%s %s %s\n' "$tag" $? "$(base64 -w 0 /run/board-agent.output)" >&3
done
