#!/usr/bin/env bash
# What an environment is made of (a CycloneDX bill of materials), and whether advisories are known about any of it.
#   scripts/sbom.sh tools                        installs the two tools into build/sbom-tools, from the package index
#   scripts/sbom.sh bom  [WHAT] [BOM]            writes the bill of materials
#   scripts/sbom.sh scan [BOM]                   looks for advisories about what a bill of materials lists
#   scripts/sbom.sh                              all three, of .venv
# WHAT is a Python interpreter (default .venv/bin/python), or a file of `pip freeze`, for an image:
#   docker run --rm --entrypoint python regnf-worker -m pip freeze >worker.txt
# Exit status of a scan: 0 nothing is known, 1 advisories are listed, 3 it was NOT DONE: the tools or the advisories are
# out of reach. pip-audit keeps no advisories of its own; it asks for each package, so a scan needs the network.
set -uo pipefail
cd "$(dirname "$0")/.."
tools=${REGNF_SBOM_TOOLS:-build/sbom-tools}
default_bom=build/sbom.cdx.json

not_done() {
    echo "NOT DONE: $1" >&2
    exit 3
}

install_tools() {
    [[ -x $tools/bin/cyclonedx-py && -x $tools/bin/pip-audit ]] && return
    python3 -m venv "$tools" && "$tools/bin/pip" install --quiet --no-deps --requirement scripts/sbom-tools.txt ||
        not_done "the tools cannot be installed"
}

write_bom() {
    local what=$1 bom=$2 kind=environment
    [[ -x $tools/bin/cyclonedx-py ]] || not_done "no cyclonedx-py in $tools; run scripts/sbom.sh tools"
    [[ $what == *.txt ]] && kind=requirements
    mkdir -p "$(dirname "$bom")"
    "$tools/bin/cyclonedx-py" "$kind" --short-PURLs --output-reproducible --pyproject pyproject.toml \
        --mc-type application --output-format JSON --output-file "$bom" "$what" || exit 1
    echo "wrote $bom"
}

scan() {
    local bom=$1 folder
    [[ -x $tools/bin/pip-audit ]] || not_done "no pip-audit in $tools; run scripts/sbom.sh tools"
    [[ -f $bom ]] || not_done "there is no $bom"
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    "$tools/bin/python" - "$bom" >"$folder/pins.txt" <<'PYTHON' || not_done "$bom cannot be read"
import json
import sys

with open(sys.argv[1], encoding="utf-8") as file:
    for one in json.load(file)["components"]:
        if one.get("version") and one["name"] != "regnf":
            print(f"{one['name']}=={one['version'].split('+')[0]}")
PYTHON
    # Exit status 1 means advisories as well as no answer: only a scan that was done leaves its findings behind.
    "$tools/bin/pip-audit" --strict --disable-pip --no-deps --progress-spinner off --requirement "$folder/pins.txt" \
        --vulnerability-service "${REGNF_ADVISORIES:-osv}" --format json --output "$folder/found.json" \
        2>"$folder/errors.txt"
    if ! [[ -s $folder/found.json ]]; then
        tail -n 1 "$folder/errors.txt" >&2
        not_done "the advisories are out of reach"
    fi
    "$tools/bin/python" - "$folder/found.json" "$(wc -l <"$folder/pins.txt")" <<'PYTHON'
import json
import sys

with open(sys.argv[1], encoding="utf-8") as file:
    looked_at = json.load(file)["dependencies"]
known = [(one["name"], one["version"], each["id"]) for one in looked_at for each in one.get("vulns", ())]
for name, version, advisory in known:
    print(f"{name} {version}: {advisory}")
skipped = [one["name"] for one in looked_at if "skip_reason" in one]
if skipped or len(looked_at) < int(sys.argv[2]):
    print(f"NOT DONE for all: {len(looked_at) - len(skipped)} of {sys.argv[2]} packages", *skipped, file=sys.stderr)
    sys.exit(1 if known else 3)
print(f"{len(looked_at)} packages, {len(known)} advisories")
sys.exit(1 if known else 0)
PYTHON
}

case ${1:-all} in
tools) install_tools ;;
bom) write_bom "${2:-.venv/bin/python}" "${3:-$default_bom}" ;;
scan) scan "${2:-$default_bom}" ;;
all)
    install_tools
    write_bom .venv/bin/python "$default_bom"
    scan "$default_bom"
    ;;
*)
    sed -n 's/^# \{0,1\}//p' "$0" | sed -n '2,5p' >&2
    exit 2
    ;;
esac
