#!/usr/bin/env bash
# A build on a scheduler that runs already. Its workers need one thread each:
#     dask scheduler --host 127.0.0.1 --scheduler-file scheduler.json
#     dask worker --scheduler-file scheduler.json --nthreads 1 --nworkers 8
set -euo pipefail
cd "$(dirname "$0")/../.."

python pipelines/submit_build.py \
    --cluster scheduler-file "${SCHEDULER_FILE:-scheduler.json}" \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
