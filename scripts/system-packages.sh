#!/usr/bin/env bash
# System libraries that Python packages need and cannot bring along.
#   scripts/system-packages.sh runtime   what open3d loads, and a C compiler for the native evaluator
#   scripts/system-packages.sh test      the same, a browser for the page's tests, and a Redis beside the packaged Valkey
#   scripts/system-packages.sh images    what scripts/images.sh builds and runs images with
# As root on Debian or Ubuntu it installs what is missing; otherwise it names it.
set -euo pipefail

runtime=(libgl1 libegl1 libx11-6 libusb-1.0-0 libidn2-0 libudev1 libgomp1)
compiler=(gcc libc6-dev) # without it regnf works, and takes longer
case "${1:-runtime}" in
    runtime) wanted=("${runtime[@]}" "${compiler[@]}") ;;
    test) wanted=("${runtime[@]}" "${compiler[@]}" chromium redis-tools) ;;
    images) wanted=(buildah debootstrap iproute2) ;;
    *) echo "usage: $0 runtime|test|images" >&2; exit 2 ;;
esac

if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
    echo "Not a Debian system: make sure that your system has the equivalents of: ${wanted[*]}" >&2
    exit 0
fi

missing=()
for package in "${wanted[@]}"; do
    status=$(dpkg-query -W -f='${Status}' "$package" 2>/dev/null || true)
    # Newer releases renamed some packages for 64-bit time_t.
    [[ $status == *"ok installed"* ]] && continue
    status=$(dpkg-query -W -f='${Status}' "${package}t64" 2>/dev/null || true)
    [[ $status == *"ok installed"* ]] || missing+=("$package")
done
[[ ${#missing[@]} -eq 0 ]] && exit 0

if [[ $(id -u) -ne 0 ]]; then
    echo "Missing system packages. Please run:  sudo apt-get install ${missing[*]}" >&2
    exit 0
fi
echo "Installing system packages: ${missing[*]}"
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
