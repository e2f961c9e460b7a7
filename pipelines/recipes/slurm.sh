#!/usr/bin/env bash
# A build whose workers are SLURM jobs of their own: they start as the queue lets them, and
# each that reaches its walltime is replaced. Run it where jobs are submitted, in tmux or
# screen: this process hands out the work. Partition, account and the like are taken from
# ~/.config/dask/jobqueue.yaml (see jobqueue.yaml beside this file).
# Needs: pip install 'drakegrasp[jobqueue]'.
set -euo pipefail
cd "$(dirname "$0")/../.."

python pipelines/submit_build.py \
    --cluster slurm --workers "${WORKERS:-100}" --walltime "${WALLTIME:-04:00:00}" \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
