#!/usr/bin/env bash
# Reads every frame of a result with an independent tool: PlayCanvas' splat-transform, from npm. Not part of CI.
#
#   tests/peers/splat_transform.sh DIR
#
# Fails if the tool refuses a file, warns, drops a Gaussian that is a number, or counts other Gaussians than we do.
set -euo pipefail
[ $# -eq 1 ] || { echo "usage: $0 DIR, the output folder of trackersplat reconstruct" >&2; exit 2; }
version=2.7.1
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
for ply in "$1"/static.ply "$1"/frames/*.ply; do
    expected=$(head -c 4096 "$ply" | grep -a -m 1 '^element vertex' | cut -d ' ' -f 3)
    npx --yes "@playcanvas/splat-transform@$version" --no-tty -w "$ply" --filter-nan "$scratch/read.csv" >"$scratch/log" 2>&1 \
        || { cat "$scratch/log" >&2; echo "$ply: refused" >&2; exit 1; }
    if grep -iE 'warning|error' "$scratch/log" | grep -v '^npm' >&2; then
        echo "$ply: complaint" >&2
        exit 1
    fi
    found=$(($(wc -l <"$scratch/read.csv") - 1))
    [ "$found" -eq "$expected" ] || { echo "$ply: $found of $expected Gaussians were read" >&2; exit 1; }
    echo "$ply: $found Gaussians"
done
