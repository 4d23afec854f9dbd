#!/usr/bin/env bash
# Builds the images without a container engine, and tries them: docs/deployment.md, "How the images are tried".
#   scripts/images.sh build    a Debian base, kept for the next time, and both images on it
#   scripts/images.sh try      every documented compose command through the built images
#   scripts/images.sh demo     pip install "regnf[all]" and regnf demo, on the bare base
#   scripts/images.sh clean    removes all of it
# Needs root, buildah, debootstrap and iproute2 (scripts/system-packages.sh images), and .venv or PYTHON. The base stands
# in for the python image, which comes from a registry. REGNF_IMAGES names the folder where everything is kept.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-$PWD/.venv/bin/python}
kept=${REGNF_IMAGES:-${XDG_CACHE_HOME:-$HOME/.cache}/regnf-images}
base=localhost/regnf-base
buildah=(buildah --root "$kept/store" --runroot "$kept/run")
[[ -z ${STORAGE_DRIVER:-} ]] || buildah+=(--storage-driver "$STORAGE_DRIVER")
export BUILDAH_ISOLATION=chroot

has_image() { "${buildah[@]}" inspect --type image "$1" >/dev/null 2>&1; }
# No network but its own loopback, and nothing outlives the command.
alone() { unshare --net --pid --mount-proc --fork --kill-child "$@"; }
remove_containers() { "${buildah[@]}" rm --all >/dev/null 2>&1 || true; }

make_base() {
    if has_image "$base"; then return; fi
    echo "Making a Debian base ..."
    local container root
    container=$("${buildah[@]}" from scratch)
    root=$("${buildah[@]}" mount "$container")
    debootstrap --variant=minbase --include=ca-certificates,python-is-python3,python3,python3-venv bookworm "$root" \
        >"$kept/debootstrap.log"
    rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/lib/apt/lists/*
    "${buildah[@]}" umount "$container" >/dev/null
    "${buildah[@]}" commit --quiet --rm "$container" "$base" >/dev/null
}

pip_volumes() {
    local listed
    listed=$("$python" -m scripts.images.pip_settings "$kept/pip.conf")
    mapfile -t volumes < <(sed 's/^/--volume=/' <<<"$listed")
}

build() {
    make_base
    pip_volumes
    local name started
    for name in service worker; do
        echo "Building regnf-$name ..."
        started=$SECONDS
        "${buildah[@]}" bud --quiet --format docker --layers --build-arg BASE="$base" "${volumes[@]}" \
            --file "docker/$name.Dockerfile" --tag "localhost/regnf-$name" . >"$kept/$name.log" 2>&1 ||
            { tail -n 30 "$kept/$name.log" >&2; exit 1; }
        echo "regnf-$name: built in $((SECONDS - started)) s"
    done
    "${buildah[@]}" images --format '{{.Name}}  {{.Size}}' | grep localhost/
}

try() {
    has_image localhost/regnf-worker || build
    trap remove_containers EXIT
    alone "$python" -m scripts.images.trial "${buildah[@]}"
}

demo() {
    has_image localhost/regnf-worker || build
    pip_volumes
    trap remove_containers EXIT
    local container wheel in_container
    wheel=$("${buildah[@]}" bud --quiet --layers --build-arg BASE="$base" "${volumes[@]}" --target wheel \
        --file docker/service.Dockerfile . 2>/dev/null | tail -n 1)
    container=$("${buildah[@]}" from "$base")
    "${buildah[@]}" copy --quiet --from "$wheel" "$container" /wheels /wheels >/dev/null
    "${buildah[@]}" copy --quiet "$container" constraints.txt /constraints.txt >/dev/null
    in_container=("${buildah[@]}" run "${volumes[@]}" "$container" --)
    "${in_container[@]}" python -m venv /regnf
    # torch by its pinned version: a package index may offer builds for GPUs first. All else as a stranger gets it.
    "${in_container[@]}" /regnf/bin/pip install -qq --constraint /constraints.txt torch
    "${in_container[@]}" sh -c '/regnf/bin/pip install -qq "$(echo /wheels/regnf-*.whl)[all]"'
    alone sh -c 'ip link set lo up && exec "$@"' sh "${buildah[@]}" run "$container" -- \
        sh -c '/regnf/bin/regnf demo --state-dir /demo || { tail -n 40 /demo/serve.log; exit 1; }'
}

clean() {
    if [[ ! -d $kept ]]; then return; fi
    remove_containers
    "${buildah[@]}" rmi --all --force >/dev/null
    if mountpoint --quiet "$kept/store/overlay"; then umount "$kept/store/overlay"; fi
    rm -rf "$kept"
}

if [[ ! ${1:-} =~ ^(build|try|demo|clean)$ ]]; then
    sed -n '2,6p' "$0" >&2
    exit 2
fi
mkdir -p "$kept"
"$1"
