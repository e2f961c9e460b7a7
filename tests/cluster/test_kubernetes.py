"""The manifest of a cluster of pods, by the schema of the operator that reads it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from helpers.golden import Golden

from drakegrasp.cli.main import main
from drakegrasp.cluster.kinds import cluster_of
from drakegrasp.errors import ConfigError

SCHEMA = yaml.safe_load((Path(__file__).with_name("daskcluster_schema.yaml")).read_text())
TYPES = {"object": dict, "array": list, "string": str, "integer": int, "boolean": bool}
WITH = {"image": "example.org/drakegrasp:1", "claim": "grasps"}


def faults(value: Any, schema: dict[str, Any], place: str = "") -> Iterator[str]:
    """Yield where a value is not as a schema of Kubernetes says; unknown keys are faults, too."""
    if schema.get("x-kubernetes-int-or-string"):
        if not isinstance(value, int | str):
            yield f"{place}: {value!r}"
    elif not isinstance(value, TYPES[schema["type"]]):
        yield f"{place}: {value!r} is no {schema['type']}"
    elif isinstance(value, dict):
        lacking = [key for key in schema.get("required", ()) if key not in value]
        yield from (f"{place}.{key} is missing" for key in lacking)
        known, rest = schema.get("properties"), schema.get("additionalProperties")
        for key, inner in value.items():
            of = (known or {}).get(key, rest)
            if of is not None:
                yield from faults(inner, of, f"{place}.{key}")
            elif known is not None:
                yield f"{place}.{key} is not known"
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from faults(inner, schema["items"], f"{place}[{i}]")


def manifest(**changes: Any) -> dict[str, Any]:
    cluster = cluster_of("kubernetes", workers=4, memory="3GB", **{**WITH, **changes})
    document: dict[str, Any] = yaml.safe_load(cluster.script(Path("/data/out")))
    return document


@pytest.mark.parametrize("tls", [True, False])
def test_manifest_is_what_the_operator_takes(
    tls: bool, golden: Golden, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
    document = manifest(tls=tls)
    golden(f"jobs/kubernetes_{'tls' if tls else 'open'}", yaml.safe_dump(document))
    assert document.pop("apiVersion") == "kubernetes.dask.org/v1"
    assert document.pop("kind") == "DaskCluster"
    assert document.pop("metadata") == {"name": "drakegrasp", "namespace": "default"}
    assert list(faults(document, SCHEMA)) == []


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda spec: spec["scheduler"].pop("service"), ".spec.scheduler.service is missing"),
        (lambda spec: spec["worker"].update(replicas="4"), "'4' is no integer"),
        (lambda spec: spec["worker"]["spec"].update(pods=1), ".spec.worker.spec.pods is not known"),
    ],
)
def test_schema_finds_what_the_operator_would_refuse(spoil: Any, fault: str) -> None:
    document = {"spec": manifest()["spec"]}
    spoil(document["spec"])
    (found,) = faults(document, SCHEMA)
    assert fault in found


def test_pods_have_what_workers_need() -> None:
    spec = manifest(name="mine", namespace="lab")["spec"]
    assert spec["worker"]["replicas"] == 4
    (worker,) = spec["worker"]["spec"]["containers"]
    (scheduler,) = spec["scheduler"]["spec"]["containers"]
    assert worker["resources"]["limits"] == {"memory": "3000000000"}
    assert "tls://mine-scheduler.lab.svc.cluster.local:8786" in worker["command"]
    assert worker["command"][worker["command"].index("--nthreads") + 1] == "1"
    for pod, container in ((spec["worker"], worker), (spec["scheduler"], scheduler)):
        assert {"name": "data", "mountPath": "/data"} in container["volumeMounts"]
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        assert volumes["data"]["persistentVolumeClaim"] == {"claimName": "grasps"}
        assert volumes["tls"]["secret"] == {"secretName": "mine-tls"}
        assert "--tls-key" in container["command"]
        names = [variable["name"] for variable in container["env"]]
        assert "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD" in names
    service = spec["scheduler"]["service"]
    assert service["selector"]["dask.org/cluster-name"] == "mine"
    targets = {port["targetPort"]: port["port"] for port in service["ports"]}
    assert targets == {port["name"]: port["containerPort"] for port in scheduler["ports"]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"workers": None}, "--workers must be given"),
        ({"name": "My_Cluster"}, "name must be at most 37 of a-z, 0-9 and -, got 'My_Cluster'"),
        ({"claim": "a" * 64}, "claim must be at most 63"),
        ({"image": ""}, "--with image=NAME must be given"),
        ({"host": "10.0.0.1"}, "--host must not be given with --cluster kubernetes"),
    ],
)
def test_what_kubernetes_would_refuse_is_one_line(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        cluster_of("kubernetes", **{"workers": 2, **WITH, **changes})


def test_without_a_claim_pods_have_no_volume_for_the_dataset() -> None:
    document = manifest(claim=None)
    pod = document["spec"]["worker"]["spec"]
    assert [volume["name"] for volume in pod["volumes"]] == ["tls"]
    assert [mount["name"] for mount in pod["containers"][0]["volumeMounts"]] == ["tls"]
    assert list(faults({"spec": document["spec"]}, SCHEMA)) == []


def test_volume_is_not_put_over_the_root() -> None:
    cluster = cluster_of("kubernetes", workers=2, **WITH)
    with pytest.raises(ConfigError, match="--out must be in a folder of the claim"):
        cluster.script(Path("/out"))


def test_command_writes_the_manifest_and_says_what_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["submit", "--cluster", "kubernetes", "--workers", "2", "--out", "/data/out"]
    words += ["--objects", "builtin", "--with", "image=x:1", "--with", "claim=c"]
    refused = CliRunner().invoke(main, words)
    assert refused.exit_code == 2
    assert "--script FILE or --dry-run must be given" in refused.stderr
    file = tmp_path / "cluster.yaml"
    words += ["--seed=3", "--script", str(file)]
    monkeypatch.setattr(sys, "argv", ["drakegrasp", *words])
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert yaml.safe_load(file.read_text())["kind"] == "DaskCluster"
    *_, apply, client = result.stdout.splitlines()
    assert apply == f"kubectl apply -f {file}"
    address = "tls://drakegrasp-scheduler.default.svc.cluster.local:8786"
    assert client.startswith(f"client: drakegrasp submit --scheduler {address} --tls-ca-file ")
    assert client.endswith("--out /data/out --objects builtin --seed=3")
