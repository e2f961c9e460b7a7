#!/usr/bin/env bash
# A build on this machine, with a worker on every core. The same command continues a stopped build.
set -euo pipefail
cd "$(dirname "$0")/../.."

python pipelines/submit_build.py \
    --cluster local \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
