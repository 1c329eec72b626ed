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
trap 'exit 1' HUP INT TERM # the shell forgets about EXIT otherwise
mkdir "$build/rtugate"
tar --create --file "$build/tree.tar" --warning=no-file-changed --exclude='.[!/]*' --exclude=./build --exclude=./dist \
    --exclude='*.egg-info' --exclude=__pycache__ . || [ $? = 1 ] # 1: somebody works here meanwhile; 2: it is not whole
tar --extract --file "$build/tree.tar" --no-same-owner --directory "$build/rtugate"
# The unit and the udev rule are links there, to where everything of etc/ is.
cp -RL "$build/rtugate/packaging/debian" "$build/rtugate/debian"
(cd "$build/rtugate" && dpkg-buildpackage --unsigned-source --unsigned-changes --build=binary)
mv "$build"/rtugate_* "$target/"
