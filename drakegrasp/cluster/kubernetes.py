"""A cluster of pods: the manifest of dask-kubernetes' operator, which starts them.

In: an image with drakegrasp, and a claim of a volume if one holds OUT. Out: a `DaskCluster` of
kubernetes.dask.org/v1 (dask-kubernetes 2025.7), for `kubectl apply -f -`. Nothing is started from
here: whoever applies it then connects by the scheduler's address. Scheduler and workers ask for a
certificate, which a secret of the namespace holds.
"""

from __future__ import annotations

import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml
from distributed import Client

from drakegrasp.cluster.connect import NANNY_PRELOAD, dask_settings, dask_variables
from drakegrasp.cluster.kinds import Local, memory_bytes
from drakegrasp.errors import ConfigError, MachineError

#: Memory of a worker, if the user gives none.
WORKER_MEMORY = "2GB"
#: Ports of the scheduler: of Dask, and of its dashboard, which the operator asks.
PORT, DASHBOARD = 8786, 8787
#: Where pods see the certificates, and the files there.
KEYS = "/etc/drakegrasp-tls"
FILES = {"ca-file": "ca.pem", "cert": "cert.pem", "key": "key.pem"}
#: Names in Kubernetes (RFC 1123); the operator adds `-default-worker-` and ten characters.
_NAME, _LONGEST = re.compile("[a-z0-9]([-a-z0-9]*[a-z0-9])?"), 37


@dataclass(kw_only=True)
class Kubernetes(Local):
    """Pods with a worker each, and one with the scheduler.

    Attributes:
        image: Container image with drakegrasp, as pipelines/recipes/Dockerfile makes it.
        claim: Name of the PersistentVolumeClaim in which OUT lies; pods see it at OUT's folder.
            Without one files travel over the network.
        name: Of the cluster.
        namespace: Of the cluster.
    """

    starts: ClassVar[bool] = False
    options: ClassVar[tuple[str, ...]] = ("workers", "memory")
    image: str | None = None
    claim: str | None = None
    name: str = "drakegrasp"
    namespace: str = "default"

    def __post_init__(self) -> None:
        """Refuse what the operator or Kubernetes would refuse.

        Raises:
            ConfigError: If something is missing, or a name is none of Kubernetes.
        """
        super().__post_init__()
        if self.workers is None:
            raise ConfigError(f"--workers must be given with --cluster {self.kind}")
        if not self.image:
            raise ConfigError(f"--with image=NAME must be given with --cluster {self.kind}")
        for key, most in (("name", _LONGEST), ("namespace", 63), ("claim", 63)):
            text = getattr(self, key)
            if text is None:
                continue
            if not _NAME.fullmatch(text) or len(text) > most:
                raise ConfigError(
                    f"{key} must be at most {most} of a-z, 0-9 and -, got {text[:80]!r}"
                )
        if self.tls_files is not None:
            raise ConfigError(
                f"--tls-ca-file must not be given with --cluster {self.kind}: pods read the "
                f"secret {self.secret}"
            )

    @property
    def secret(self) -> str:
        """Name of the secret with the certificates."""
        return f"{self.name}-tls"

    @property
    def address(self) -> str:
        """Address of the scheduler within Kubernetes."""
        host = f"{self.name}-scheduler.{self.namespace}.svc.cluster.local"
        return f"{'tls' if self.tls else 'tcp'}://{host}:{PORT}"

    def line(self) -> str:
        """Return what the manifest asks for, in words."""
        where = f"OUT in the claim {self.claim}" if self.claim else "which do not see OUT"
        return f"{self.workers} worker pods of {self.image}, {where}"

    def is_open(self) -> bool:
        """Return whether others reach the scheduler: all pods of the cluster do."""
        return True

    def script(self, out: Path) -> str:
        """Return the manifest, in YAML."""
        return str(yaml.safe_dump(self.manifest(out), sort_keys=False))

    def client_options(self) -> list[str]:
        """Return the options of a client in a pod that has the secret where the workers have it."""
        tls = [word for k, file in FILES.items() for word in (f"--tls-{k}", f"{KEYS}/{file}")]
        return ["--scheduler", self.address, *(tls if self.tls else ())]

    def submission(self) -> str:
        """Return the command that takes the manifest."""
        return "kubectl apply -f"

    def manifest(self, out: Path) -> dict[str, Any]:
        """Return the `DaskCluster`.

        Args:
            out: Directory of the dataset, absolute; its folder is where pods see the volume.

        Raises:
            ConfigError: If there is a claim, and `out` is in no folder.
        """
        if self.claim and out.parent == Path(out.anchor):
            raise ConfigError(f"--out must be in a folder of the claim, e.g. /data/OUT, got {out}")
        python = ["python", "-m"]
        tls = [w for k, file in FILES.items() for w in (f"--tls-{k}", f"{KEYS}/{file}")]
        tls = tls if self.tls else []
        scheduler = [
            *(*python, "distributed.cli.dask_scheduler", "--host", "0.0.0.0"),
            *("--port", str(PORT), "--dashboard-address", f":{DASHBOARD}"),
            *(*tls, *(["--protocol", "tls"] if self.tls else [])),
        ]
        memory = memory_bytes(self.memory or WORKER_MEMORY)
        worker = [
            # The address that the operator sets is without TLS.
            *(*python, "distributed.cli.dask_worker", self.address),
            *("--name", "$(DASK_WORKER_NAME)", "--nthreads", "1", "--memory-limit", f"{memory}B"),
            *("--preload-nanny", NANNY_PRELOAD, *tls),
        ]
        labels = {"dask.org/cluster-name": self.name, "dask.org/component": "scheduler"}
        ports = {"tcp-comm": PORT, "http-dashboard": DASHBOARD}
        return {
            "apiVersion": "kubernetes.dask.org/v1",
            "kind": "DaskCluster",
            "metadata": {"name": self.name, "namespace": self.namespace},
            "spec": {
                "worker": {
                    "replicas": self.workers,
                    "spec": self._pod("worker", worker, out, memory, {}),
                },
                "scheduler": {
                    "spec": self._pod("scheduler", scheduler, out, None, ports),
                    "service": {
                        "type": "ClusterIP",
                        "selector": labels,
                        "ports": [
                            {"name": name, "protocol": "TCP", "port": port, "targetPort": name}
                            for name, port in ports.items()
                        ],
                    },
                },
            },
        }

    def _pod(
        self, name: str, args: list[str], out: Path, memory: int | None, ports: dict[str, int]
    ) -> dict[str, Any]:
        """Return the specification of a pod with one container."""
        # What it asks for, and the folders that it sees.
        asked = {"cpu": "1", **({} if memory is None else {"memory": str(memory)})}
        mounts, volumes = list[dict[str, str]](), list[dict[str, Any]]()
        if self.claim:
            mounts.append({"name": "data", "mountPath": str(out.parent)})
            volumes.append({"name": "data", "persistentVolumeClaim": {"claimName": self.claim}})
        if self.tls:
            mounts.append({"name": "tls", "mountPath": KEYS})
            volumes.append({"name": "tls", "secret": {"secretName": self.secret}})

        # One container.
        container: dict[str, Any] = {
            "name": name,
            "image": self.image,
            "command": args,
            "env": [{"name": k, "value": v} for k, v in dask_variables(dask_settings()).items()],
            "resources": {"requests": asked, "limits": {k: asked[k] for k in asked if k != "cpu"}},
            "volumeMounts": mounts,
        }
        if ports:
            container["ports"] = [
                {"name": key, "containerPort": port, "protocol": "TCP"}
                for key, port in ports.items()
            ]
        return {"containers": [container], "volumes": volumes}

    def connected(self, out: Path) -> AbstractContextManager[Client]:
        """Refuse: the operator starts the workers.

        Raises:
            MachineError: Always.
        """
        raise MachineError(f"kubectl must start the workers; then give --scheduler {self.address}")
