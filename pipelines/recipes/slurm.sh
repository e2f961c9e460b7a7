#!/usr/bin/env bash
# A build in which each worker is a SLURM job: jobs start as the queue lets them, and a job that
# reaches its walltime is replaced. Run the script where jobs are submitted, in tmux or screen,
# because this process hands out the work. Partition, account and similar settings are read from
# ~/.config/dask/jobqueue.yaml (see jobqueue.yaml beside this file).
# Needs: pip install 'drakegrasp[jobqueue]'.
set -euo pipefail
cd "$(dirname "$0")/../.."

python pipelines/submit_build.py \
    --cluster slurm --workers "${WORKERS:-100}" --walltime "${WALLTIME:-04:00:00}" \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
