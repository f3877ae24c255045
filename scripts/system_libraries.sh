#!/bin/sh
# Open3D's wheel links to system libraries that a fresh Debian or Ubuntu lacks; numba's to OpenMP, without which
# two threads cannot run kernels at once. Install them where that is allowed, else print the one line to run.
set -eu
libraries="libusb-1.0.so.0 libEGL.so.1 libGL.so.1 libX11.so.6 libudev.so.1 libidn2.so.0 libgomp.so.1"
packages="libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0 libgomp1"

missing() {
    known=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
    for library in $libraries; do
        case "$known" in
            *"$library"*) ;;
            *) printf '%s ' "$library" ;;
        esac
    done
}

[ "$(uname -s)" = Linux ] || exit 0
lacking=$(missing)
[ -n "$lacking" ] || exit 0

as_root=""
if [ "$(id -u)" != 0 ]; then
    if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then as_root="sudo"; else as_root="no"; fi
fi
if [ "$as_root" = no ] || ! command -v apt-get >/dev/null; then
    echo "system libraries are missing: $lacking" >&2
    echo "install them with: sudo apt-get install $packages" >&2
    exit 1
fi
$as_root apt-get update -qq
DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends $packages >/dev/null
