#!/usr/bin/env bash
# A build on machines that this one reaches by ssh without a password; the first machine also runs
# the scheduler. All machines must see this environment and OUT at the same paths. Users, ports and
# keys of the machines belong into ~/.ssh/config, their host keys into ~/.ssh/known_hosts.
# Needs: pip install 'drakegrasp[ssh]'.
set -euo pipefail
cd "$(dirname "$0")/../.."

# HOSTS: names separated by blanks. NETWORK: interface through which the machines are connected.
read -r -a hosts <<<"${HOSTS:?names of the machines}"
python pipelines/submit_build.py \
    --cluster ssh "${hosts[@]}" --cores "${CORES:?workers on each machine}" \
    --interface "${NETWORK:?such as eth0}" \
    --objects "${MESHES:-builtin}" --units "${UNITS:-m}" --out "${OUT:?directory of the dataset}" \
    "$@"
