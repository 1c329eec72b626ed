#!/bin/sh
# Builds the Debian package of this tree, as it lies there: build.sh FOLDER puts rtugate_VERSION_all.deb, its .changes
# and .buildinfo into FOLDER. `make deb` calls it. Neither the tree nor what is built has to be root's.
set -eu
mkdir -p "$1"
target=$(cd "$1" && pwd)
cd "$(dirname "$0")/.."

for program in gcc dpkg-buildpackage dh dh_python3; do # gcc: dpkg-buildpackage wants all of build-essential
    if ! command -v $program >/dev/null; then
        echo "$program is missing: apt-get install build-essential debhelper dh-python" >&2
        exit 1
    fi
done

build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
mkdir "$build/rtugate"
tar --create --exclude='./.*' --exclude=./build --exclude=./dist --exclude='*.egg-info' --exclude=__pycache__ . |
    tar --extract --no-same-owner --directory "$build/rtugate"
# The unit and the udev rule are links there, to where everything of etc/ is.
cp -RL "$build/rtugate/packaging/debian" "$build/rtugate/debian"
(cd "$build/rtugate" && dpkg-buildpackage --unsigned-source --unsigned-changes --build=binary)
mv "$build"/rtugate_* "$target/"
