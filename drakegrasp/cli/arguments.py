"""What the arguments of commands share: the types of their values, and options that several have.

Cyclopts reads the options of a command from its signature and its docstring. Types that are used
here and in commands are therefore imported when the module is.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from cyclopts import Parameter
from cyclopts.validators import Number

import drakegrasp as dg
from drakegrasp.cli.console import CLUSTER, MORE, UsageError
from drakegrasp.errors import first_line
from drakegrasp.foreign_files import ADDRESS

if TYPE_CHECKING:
    from cyclopts import Token

    from drakegrasp.config import Config


def read_path(kind: Any, tokens: tuple[Token, ...]) -> Path:
    """Return the path of this machine that a word names.

    Raises:
        ValueError: If it is empty, e.g. an unset variable of a shell, or an address, or no file can
            have it.
    """
    text = tokens[0].value
    if not text.strip():
        raise ValueError(f"must be a path, got {text!r}")
    if ADDRESS.match(text):
        raise ValueError(f"must be a path of this machine, got the address {text!r}")
    try:
        os.lstat(text)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass
    except (OSError, ValueError) as error:
        raise ValueError(
            f"must be a path, got one that no file has ({first_line(error)})"
        ) from None
    return Path(text)


def read_whole(kind: Any, tokens: tuple[Token, ...]) -> int:
    """Return the whole number that a word states; cyclopts alone would round 1.5.

    Raises:
        ValueError: If it states none.
    """
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"must be a whole number, got {tokens[0].value!r}") from None


def validate_existing(kind: Any, path: Path | None) -> None:
    """Reject a path at which nothing is."""
    if path is not None and not path.exists():
        raise ValueError("Must exist, got nothing there.")


def validate_existing_file(kind: Any, path: Path | None) -> None:
    """Reject a path that is not that of a file."""
    if path is not None and not path.is_file():
        raise ValueError(f"Must be a file, got {'a folder' if path.is_dir() else 'nothing there'}")


def validate_no_folder(kind: Any, path: Path | None) -> None:
    """Reject the path of a folder where a file is written."""
    if path is not None and path.is_dir():
        raise ValueError("Must be a file, got a folder.")


def tidy_dataset(kind: Any, path: Path) -> None:
    """Clean up what a dead process left in a dataset, before a command reads the dataset."""
    from drakegrasp.dataset.lock import tidy

    if path.is_dir():
        tidy(path)


#: Paths: any, of a file or folder that exists, of a file that exists, of a file to write.
AnyPath: TypeAlias = Annotated[Path, Parameter(converter=read_path, metavar="PATH")]
Existing: TypeAlias = Annotated[AnyPath, Parameter(validator=validate_existing)]
File: TypeAlias = Annotated[AnyPath, Parameter(validator=validate_existing_file, metavar="FILE")]
NewFile: TypeAlias = Annotated[AnyPath, Parameter(validator=validate_no_folder, metavar="FILE")]
Folder: TypeAlias = Annotated[AnyPath, Parameter(metavar="DIR")]
#: The directory of a dataset, and a data file.
Dataset: TypeAlias = Annotated[AnyPath, Parameter(validator=tidy_dataset)]
DataFile: TypeAlias = Annotated[AnyPath, Parameter(metavar="FILE")]
#: Numbers of things.
Count: TypeAlias = Annotated[int, Parameter(converter=read_whole, metavar="N")]
Positive: TypeAlias = Annotated[Count, Parameter(validator=Number(gte=1))]
#: Texts.
Name: TypeAlias = Annotated[str, Parameter(metavar="NAME")]
Preset: TypeAlias = Annotated[str, Parameter(metavar="YAML|PRESET")]
Settings: TypeAlias = Annotated[tuple[str, ...], Parameter(name="--set", metavar="KEY=VALUE")]
Units: TypeAlias = Literal["m", "cm", "mm"]
Split: TypeAlias = Literal["train", "valid", "test"]
GraspFrame: TypeAlias = Literal["object", "table", "camera", "world", "mesh"]
#: Of postures on a dataset; a file cannot say which of its meshes it means.
RowFrame: TypeAlias = Literal["object", "table", "camera", "world"]
AsJson: TypeAlias = Annotated[bool, Parameter(name="--json")]


@Parameter(name="*", group=MORE)
@dataclass(frozen=True, kw_only=True)
class Postures:
    """How files of postures are read.

    Attributes:
        link: Frame or link of the poses in files of postures, which overrides the files: palm, the
            palm link, or a frame of another tool that the hand file names, e.g. graspgen.
        preshape: Preshape for rows of postures that name none; the value each, for palm poses
            alone, tries all preshapes in turn.
    """

    link: Name | None = None
    preshape: Name | None = None

    def asked(self) -> dict[str, str]:
        """Return the arguments of `exchange.attempts.read_attempts` that these options state."""
        return given(link=self.link, preshape=self.preshape)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class What:
    """What a build makes, and how.

    Attributes:
        objects: A directory of .obj, .stl, .ply or .glb files, or the built-in objects.
        out: Directory of the dataset. The same command continues an interrupted build.
        config: Configuration: a file, or the preset paper, released, fast, randomized, bench1 or
            clutter1. [default: fast]
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
        samples: Stop when all objects together have N samples; a larger N continues the build.
        samples_per_object: Stop an object when it has N samples. [default: 20, with fast and
            without --samples and --candidates]
        candidates: Largest number of palm poses per object. [default: 10000]
        only: Build this object only; may be given several times.
        seed: Seed of all random draws. [default: 0]
        units: Unit of length of the meshes.
        quiet: Show no progress.
        per_class: Number of built-in objects of each class. [default: 2]
        objects_seed: Seed of the sizes of the built-in objects. [default: 0]
        manifest: YAML file with units and classes by mesh. [default: objects.yaml in the directory
            of the meshes]
        postures: Try these postures (wrist and joints) instead of drawn palm poses, on the objects
            that the postures name: .npz, .hdf5, DexGraspBench .npy or isaac_grasp .yaml.
    """

    objects: Annotated[str, Parameter(metavar="MESH_DIR|builtin")]
    out: Folder
    config: Preset | None = None
    overrides: Settings = ()
    samples: Count | None = None
    samples_per_object: Count | None = None
    candidates: Count | None = None
    only: Annotated[tuple[str, ...], Parameter(metavar="NAME")] = ()
    seed: Count | None = None
    units: Units = "m"
    quiet: bool = False
    per_class: Annotated[Count | None, Parameter(group=MORE)] = None
    objects_seed: Annotated[Count | None, Parameter(group=MORE)] = None
    manifest: Annotated[AnyPath | None, Parameter(group=MORE, metavar="FILE")] = None
    postures: Annotated[Existing | None, Parameter(group=MORE, metavar="FILE|DIR")] = None
    reading: Postures = Postures()

    def asked(self) -> dict[str, Any]:
        """Return the arguments of `build_dataset` and `known_work` that these options state.

        Raises:
            UsageError: If options do not fit each other.
            ConfigError: If a value of the configuration cannot be used.
            HandError: If the hand's file cannot be read.
        """
        read_as = self.reading.asked()
        if read_as and self.postures is None:
            raise UsageError(f"--{next(iter(read_as))} must be used with --postures")
        asked = {name: getattr(self, name) for name in ("objects", "units", "manifest", "only")}
        return {**asked, "config": self._resolved(), "postures": self.postures, "read_as": read_as}

    def _resolved(self) -> Config:
        """Return the configuration, in which options are short forms of `--set`."""
        from drakegrasp.config import BUILD_PRESET
        from drakegrasp.generation.directory import BUILTIN

        builtin = given(per_class=self.per_class, seed=self.objects_seed)
        if builtin and self.objects != BUILTIN:
            name = "--objects-seed" if self.per_class is None else "--per-class"
            raise UsageError(f"{name} must be used with --objects builtin, got {self.objects}")
        keys = {f"builtin.{name}": value for name, value in builtin.items()}
        keys |= given(samples=self.samples, seed=self.seed)
        keys |= given(samples_per_object=self.samples_per_object)
        keys |= given(**{"candidates.max": self.candidates})
        settings = [f"{key}={value}" for key, value in keys.items()]
        config = BUILD_PRESET if self.config is None else self.config
        return dg.load_config(config, [*self.overrides, *settings])


@Parameter(name="*", group=CLUSTER)
@dataclass(frozen=True, kw_only=True)
class Tls:
    """The certificates of connections.

    Attributes:
        tls: Whether connections need a certificate. Workers that the command starts get a
            certificate that is created for the run. [default: tls]
        tls_ca_file: Your own certificate authority (PEM), if a running scheduler needs one;
            requires the next two options.
        tls_cert: Certificate of client, scheduler and workers, signed by that authority.
        tls_key: Private key of the certificate.
    """

    tls: Annotated[bool, Parameter(negative="--no-tls")] = True
    tls_ca_file: File | None = None
    tls_cert: File | None = None
    tls_key: File | None = None

    def asked(self) -> dict[str, Any]:
        """Return the arguments of `connect` and of clusters that these options state.

        Raises:
            UsageError: If only some of the files are given.
        """
        files = (self.tls_ca_file, self.tls_cert, self.tls_key)
        if None in files and any(files):
            raise UsageError("--tls-ca-file, --tls-cert and --tls-key must be given together")
        return {"tls": self.tls, "tls_files": files if any(files) else None}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where the work runs.

    Attributes:
        workers: Number of processes on this machine. [default: one per core]
        scheduler: Use the running Dask scheduler at this address.
        scheduler_file: Use the running Dask scheduler that wrote this file.
    """

    workers: Count | None = None
    scheduler: Annotated[str | None, Parameter(group=CLUSTER, metavar="ADDRESS")] = None
    scheduler_file: Annotated[AnyPath | None, Parameter(group=CLUSTER, metavar="FILE")] = None
    certificates: Tls = Tls()

    def asked(self) -> dict[str, Any]:
        """Return the arguments of `connect` that these options state."""
        names = ("workers", "scheduler", "scheduler_file")
        return {name: getattr(self, name) for name in names} | self.certificates.asked()


def given(**options: Any) -> dict[str, Any]:
    """Return the options that were given."""
    return {name: value for name, value in options.items() if value is not None}
