#!/usr/bin/env bash
# A build on a scheduler that is already running. Its workers need one thread each:
#     python pipelines/make_certificates.py keys
#     tls="--tls-ca-file keys/ca.pem --tls-cert keys/cert.pem --tls-key keys/key.pem"
#     dask scheduler $tls --protocol tls --host 127.0.0.1 --scheduler-file scheduler.json
#     dask worker $tls --scheduler-file scheduler.json --nthreads 1 --nworkers 8
# KEYS is the folder of the certificates.
set -euo pipefail
cd "$(dirname "$0")/../.."
keys=${KEYS:-keys}

python pipelines/submit_build.py \
    --scheduler-file "${SCHEDULER_FILE:-scheduler.json}" \
    --tls-ca-file "$keys/ca.pem" --tls-cert "$keys/cert.pem" --tls-key "$keys/key.pem" \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
