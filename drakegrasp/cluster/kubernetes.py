"""A cluster of pods, as a manifest for the operator of dask-kubernetes, which starts them.

Input: an image with drakegrasp, and a volume claim if a volume holds OUT. Output: a `DaskCluster`
of kubernetes.dask.org/v1 (dask-kubernetes 2025.7), for `kubectl apply -f -`. This module starts
nothing. The user applies the manifest and then connects to the scheduler's address. Scheduler and
workers require a certificate, which is stored in a secret of the namespace.
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

#: Memory of a worker, if the user does not state it.
WORKER_MEMORY = "2GB"
#: Ports of the scheduler, for Dask and for its dashboard, which the operator queries.
PORT, DASHBOARD = 8786, 8787
#: Folder in which pods see the certificates, and the names of the files.
KEYS = "/etc/drakegrasp-tls"
FILES = {"ca-file": "ca.pem", "cert": "cert.pem", "key": "key.pem"}
#: Names in Kubernetes (RFC 1123); the operator adds `-default-worker-` and ten characters.
_NAME, _LONGEST = re.compile("[a-z0-9]([-a-z0-9]*[a-z0-9])?"), 37


@dataclass(kw_only=True)
class Kubernetes(Local):
    """Pods with one worker each, and a pod with the scheduler.

    Attributes:
        image: Container image with drakegrasp, as pipelines/recipes/Dockerfile builds it.
        claim: Name of the PersistentVolumeClaim of the volume that holds OUT. Pods mount it at the
            folder of OUT. Without a claim, files are sent over the network.
        name: Name of the cluster.
        namespace: Namespace of the cluster.
    """

    starts: ClassVar[bool] = False
    options: ClassVar[tuple[str, ...]] = ("workers", "memory")
    image: str | None = None
    claim: str | None = None
    name: str = "drakegrasp"
    namespace: str = "default"

    def __post_init__(self) -> None:
        """Reject values that the operator or Kubernetes would reject.

        Raises:
            ConfigError: If a value is missing, or a name is not a valid name in Kubernetes.
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
        """Return a description of what the manifest requests."""
        where = f"OUT in the claim {self.claim}" if self.claim else "which do not see OUT"
        return f"{self.workers} worker pods of {self.image}, {where}"

    def is_open(self) -> bool:
        """Return True, because all pods of the Kubernetes cluster reach the scheduler."""
        return True

    def script(self, out: Path) -> str:
        """Return the manifest, in YAML."""
        return str(yaml.safe_dump(self.manifest(out), sort_keys=False))

    def client_options(self) -> list[str]:
        """Return the options of a client in a pod that mounts the secret as the workers do."""
        tls = [word for k, file in FILES.items() for word in (f"--tls-{k}", f"{KEYS}/{file}")]
        return ["--scheduler", self.address, *(tls if self.tls else ())]

    def submission(self) -> str:
        """Return the command that takes the manifest."""
        return "kubectl apply -f"

    def manifest(self, out: Path) -> dict[str, Any]:
        """Return the `DaskCluster`.

        Args:
            out: Absolute path of the dataset; pods mount the volume at its parent folder.

        Raises:
            ConfigError: If there is a claim, and `out` is directly in the root folder.
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
            # The operator sets an address without TLS.
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
        # The requested resources, and the mounted folders.
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
        """Raise an error, because the operator starts the workers.

        Raises:
            MachineError: Always.
        """
        raise MachineError(f"kubectl must start the workers; then give --scheduler {self.address}")
