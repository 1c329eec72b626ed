#!/bin/sh
# Builds what every virtual board starts from: base.sh FOLDER MIRROR PACKAGES, the last with commas. In FOLDER are then
# root.ext4, a whole Debian 13 with PACKAGES and the agent, and kernel and initrd, which need no boot loader.
# Runs as root. Nothing is mounted but /proc of the new system, for as long as its packages are set up.
set -eu
folder=$1 mirror=$2 packages=$3
here=$(dirname "$0")
root=$folder/root

debootstrap --force-check-gpg --variant=minbase --include="$packages" trixie "$root" "$mirror"
rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/lib/apt/lists/*

echo board >"$root/etc/hostname"
echo 0123456789abcdef0123456789abcdef >"$root/etc/machine-id"
echo '/dev/vda / ext4 defaults 0 0' >"$root/etc/fstab"
install -m 755 "$here/agent.sh" "$root/usr/local/sbin/board-agent"
install -m 644 "$here/agent.service" "$root/etc/systemd/system/board-agent.service"
systemctl --root="$root" --quiet enable board-agent.service
systemctl --root="$root" --quiet mask apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer
systemctl --root="$root" --quiet mask getty@tty1.service getty-static.service

# Debian's own initrd looks for every disk there is, which takes a software processor 5 s at each boot.
mkdir -p "$root/initrd/bin" "$root/initrd/dev" "$root/initrd/root"
cp "$root/usr/bin/busybox" "$root/initrd/bin/"
install -m 755 "$here/init.sh" "$root/initrd/init"
xz -dc "$root"/usr/lib/modules/*/kernel/drivers/block/virtio_blk.ko.xz >"$root/initrd/virtio_blk.ko"
chroot "$root" sh -c 'cd /initrd && find . | busybox cpio -o -H newc' >"$folder/initrd"
cp "$root"/boot/vmlinuz-* "$folder/kernel"
rm -rf "$root/initrd" "$root"/boot/*

mke2fs -q -t ext4 -d "$root" "$folder/root.ext4" 2G
rm -rf "$root"
