#!/bin/sh
# First process of the lab's kernel. Its root is the host's file system, read-only (hostfs).
# From the kernel's command line: LAB, the exchange directory with `command` (a script) and
# `writable` (directories, one a line); MODULES, where the kernel's modules are. Leaves there
# `stdout` and `stderr` of the command, and `status`, whose existence says that all is over.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
ROOT=/mnt/root

fail() {
    echo "lab: the guest cannot $1" >>"$LAB/stderr"
    finish 125
}

finish() {
    sync
    echo "$1" >"$LAB/status.new" && mv "$LAB/status.new" "$LAB/status"
    sleep 60  # the host ends us
    exit
}

mount -t proc proc /proc
# Written through at once, so that the host can follow the output while the command runs.
mount -t hostfs -o "sync,$LAB" none "$LAB" || exit

insmod "$MODULES/kernel/fs/overlayfs/overlay.ko" || fail "load overlayfs"
mount -t tmpfs -o mode=755 scratch /mnt || fail "mount a tmpfs"
mkdir /mnt/changes /mnt/work "$ROOT"
mount -t overlay -o lowerdir=/,upperdir=/mnt/changes,workdir=/mnt/work overlay "$ROOT" ||
    fail "lay a writable file system over the host's"
mount -t proc proc "$ROOT/proc" && mount -t sysfs sys "$ROOT/sys" &&
    mount -t devtmpfs dev "$ROOT/dev" || fail "mount /proc, /sys and /dev"
mkdir -p "$ROOT/dev/pts" "$ROOT/dev/shm"
mount -t devpts -o mode=620,ptmxmode=666 devpts "$ROOT/dev/pts"
mount -t tmpfs -o mode=1777 shm "$ROOT/dev/shm"
mount -t tmpfs run "$ROOT/run"
ln -sfn /proc/self/fd "$ROOT/dev/fd"
while read -r directory; do
    mkdir -p "$ROOT$directory"
    mount -t hostfs -o "$directory" none "$ROOT$directory" || fail "reach $directory"
done <"$LAB/writable"

mkdir -p "$ROOT/lib/modules"
ln -sfn "$MODULES" "$ROOT/lib/modules/$(uname -r)"
for module in can can-raw can-gw vcan vxcan slcan; do
    chroot "$ROOT" modprobe "$module" || fail "load the module $module"
done
. "${0%/*}/interfaces.sh" || fail "make the CAN interfaces"
echo -1 >/proc/sys/kernel/sched_rt_runtime_us
hostname lab

chroot "$ROOT" /bin/sh "$LAB/command" </dev/null >"$LAB/stdout" 2>>"$LAB/stderr"
finish $?
