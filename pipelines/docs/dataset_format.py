"""Write docs/reference/dataset-format.md from the schema table, or check that it is up to date.

Usage: python pipelines/docs/dataset_format.py [--check] FILE
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

import generated_page

from drakegrasp.dataset import schema

_HEAD = f"""<!-- Made by `make docs-pages` from dataset/schema.py: change that, not this. -->

# The dataset's format

Schema version {schema.SCHEMA_VERSION}. In the shapes, `N` is the number of rows, `k` the number of
fingers, `j` the number of the hand's joints, `6k` the length of a grasp (18 for three fingers) and
`S` the edge length of the images. In `scenes.hdf5`, `h` and `w` are the height and width of the
images, and `o` is the number of objects in a scene. Frames are explained in
[frames-and-units.md](frames-and-units.md). Every HDF5 dataset stores its `unit`, `frame` and
`meaning` as attributes; a dataset over joints (`j`) also stores the names of its `joints`, in JSON.

```
OUT/
  manifest.json            configuration, its hash, seed, versions, objects, refused meshes
  hand/                    the hand: hand file, model, meshes, licences
  objects/NAME.npz         an object: meshes, mass, centre of mass, inertia
  objects/NAME.plan.h5     its resting pose and palm poses
  shards/NAME/RANGE.h5     results of one work unit; immutable
  trials.hdf5              a row per attempt, whatever its outcome
  grasping_oto.hdf5        samples; the camera is rolled with the palm
  grasping_otm.hdf5        the same samples; up in the image is up in the world
  reach/NAME.hdf5          which samples an arm reaches; on request
  reach/clutter/NAME.hdf5  which free grasps of clutter.hdf5 it reaches; on request
  scenes.hdf5              views that do not depend on a grasp, and all closed hands; on request
  clutter.hdf5             the same for scenes of several objects; on request
  reject.json              grasps that an inspection rejects; only if there are any
  build.lock               process that builds; only while a build runs
```

A changed bit is detected when a file is read: `sha256` in the manifest is the hash of its other
keys, shards and plans have a seal, and the HDF5 files store checksums of their columns and of the
locations of these columns. Texts in HDF5 (names, attributes) have no checksum: the seals of the
files cover them, which `check` verifies.

Only the data files, `grasping_*.hdf5`, are needed to train. With `objects/`, `hand/` and
`manifest.json`, every trial can be replayed.

`hand/` is copied when a build begins, and read by workers and by every later command. The files
keep their places, below the folder of the hand file, and bytes. `versions` in the manifest contains
a digest of these files, without licences and paths. A build continues with a hand of the
same digest, wherever the hand is and whatever the name of its file; `merge` requires the same
digest, and `check` compares it.
"""

_CONTRACT = """## What makes two files equal

The same command produces the same arrays, whatever the number of workers, the order in which they
work, and the number of interruptions: nothing in these files depends on the clock or the machine's
name. `time_close` and `time_lift` are simulated seconds. This holds on one machine with one set of
library versions (`manifest.json` lists them); a different CPU or Drake version may round
differently. The exceptions are the outcomes `timeout` and `crashed`: an attempt that computes for
longer than `attempt_seconds` (60 s; an attempt usually takes about one second), or that ends its
process again and again, depends more on the machine than on the grasp, and may end differently
elsewhere.
`screened` is an attempt that was decided by geometry: it was not simulated, and would have been a
`missing_fingertip`, see [screening](../explanation/screening.md).

## Where closing ends

`time_close` and all names that begin with `closed_` refer to the moment at which closing ended.
Usually all fingers stand still at that moment. Closing ends earlier as soon as one finger has
passed the last angle at which it can meet the object: the verdict is then `missing_fingertip`,
whatever the other fingers do. So in rows of `missing_fingertip` other fingers may still be moving,
and `closed_q` is not a fully closed hand.

While the hand closes, the object is fixed in its place. So no column states whether the object
rests on the table then, and the forces of the fingertips need not balance.

## Versions of the schema

Files with the `schema_version` above can be read. Any other version is rejected with a message that
names the file and both versions: build the dataset again, in another directory. The
changelog states what each version changed.

## Seals

A seal is the SHA-256 of a file, in its first 512 bytes, which HDF5 leaves free. Shards and the
files in `objects/` are sealed: a changed bit in one of them is detected when the file is used. The
three main files, `scenes.hdf5` and `clutter.hdf5` are sealed, too; `drakegrasp check` verifies
their seals, which reads the files as a whole. `drakegrasp assemble` rebuilds the three files from
the shards; a build does so by itself if they do not match the present shards and manifest. A list
of rejected trials (`assemble --reject`) is kept in the manifest until the next `assemble`.

New files get their names one after the other, and the manifest is the last. A process that is
killed meanwhile leaves files without the `signature` of the manifest: `drakegrasp check` reports
them, and the next build or `assemble` writes them again.

## An untrusted dataset

A dataset may come from an untrusted source. No link in its directory is followed when something is
written or deleted. An HDF5 file that has soft or external links, values in another file, or more
rows than its bytes can hold is rejected, and so are pipes, devices and files that are larger than
their kind can be; a link to a file is followed for reading, because the cache of a hub needs that.
Object names must be plain names: printable, without slashes. Files that the hand in `hand/` names
must be in this folder: links that lead out, other paths and more than 512 MB are rejected. Control
characters never reach a terminal, log or page.

## Missing values

The two data files contain no NaN. In `trials.hdf5` a value that does not exist for a row is NaN
(floats), 0 or false: the column "from" above names the stage from which a value exists. Contact
points and normals, and how they fit the mesh, are also NaN for a finger that does not touch. The
stage of a row follows from its outcome: with `success`, `slipped`, `partly_held`, `dropped` and
`moved` a lift was tried; with `missing_fingertip` and `hand_contact` the hand was closed; with
`table_contact` it was closed, and a lift was tried if `time_lift` is a number (then the object
still touched the table, or the hand scraped it in the lift); all others were only placed. "After
the lift" is the moment at which the lift ended; for `moved`, the moment at which it was aborted.
`solver_error`, `timeout` and `crashed` mean that the simulator failed: never count them as failed
grasps. `moved` means that the attempt is not a sample, not that the hand would have lost the
object.
"""


_ATTRIBUTES = """
Further attributes: `schema_version`, `camera` and `split_by` (`class` or `object`) of the data
files, camera matrix `K` [px], `near` and `far` [m], `config` and `versions` (JSON), `config_hash`,
`seed`, and the names of the hand's `fingers` and `joints` in their order (JSON). Two attributes
identify the content from which the file was assembled: `signature`, a hash of everything in the
manifest that decides a row, and `shards`, a hash of the shards' seals.
"""

_DATA = """## grasping_oto.hdf5 and grasping_otm.hdf5

The groups `/train`, `/valid` and `/test` have the same fields; images and masks are stored in one
chunk per sample, gzip 1 with shuffle. They contain only successes that pass the filters.

A sample has two grasps. `grasps` are the contacts at the moment when closing ended, on the object
before it is freed. `grasps_lifted` are the contacts at the end of the lift, when the object may
have moved in the hand; they are drawn on the object in its resting pose, as if hand and object were
moved back together. All names that end in `_lifted` refer to that moment and are expressed in this
way. `grasp_props/` describes how well the hand holds; its terms are explained in
[outcomes](outcomes.md#lifted-precision-stable). `conditions/` are the values in use, whether they
were drawn for the attempt or not, see [randomisation](../explanation/randomization.md).
"""

_SCENES = """
## scenes.hdf5

`drakegrasp scenes` writes this file, see [training on scenes](../how-to/train-on-scenes.md). A
scene is an object in a resting pose, somewhere on the table. All cameras of a scene share its
colours and its light, and each camera has its own depth noise. The file has the attributes of
`trials.hdf5` except `K`; `near` and `far` are those of its cameras. Images are stored in one chunk
each, gzip 1. Unlike in the data files, values are NaN where no lift was tried.

`drakegrasp clutter` writes `clutter.hdf5` with the same groups, see [grasps among other
objects](../how-to/clutter.md). There `o` is the largest number of objects of a scene, and `/grasps`
has the samples of all of them. Its attribute `clutter` (JSON) says what was asked for: `objects`,
`tries`, and the boxes and hulls of all `surroundings` by their names: a hull is that of `vertices`
(n, 3) in {T} [m].

### /scenes
"""

_REACH = """
## reach/NAME.hdf5

`drakegrasp reach` writes such a file for an arm, see [the guide](../how-to/reach.md). A row belongs
to the attempt of `object`, `candidate` and `standoff_index`, also after the dataset grew. The file
has the attributes of `trials.hdf5` except `signature`, `K`, `near` and `far`, and those of the arm:
its name `arm`, a hash `arm_sha256` of its file and meshes, its links and joints without meshes
`arm_urdf`, `flange`, the names `arm_joints` of its joints (JSON), `base` (X, Y, Z and yaw of its
first link in {T} [m, rad]) and `mount` (X_FB, the hand's palm link on the flange). `a` is the
number of its joints.

### /reach
"""

_CLUTTER_REACH = """
## reach/clutter/NAME.hdf5

`drakegrasp reach --clutter` writes the same for the free grasps of `clutter.hdf5`, whose attributes
`signature` and `clutter` it has, too.

### /clutter
"""

_VERIFICATION = """
## The results of `drakegrasp verify`

`drakegrasp verify ... --out FILE.h5` writes one row per grasp in the order of the input. The file
has the attributes `convention_*`, `schema_version`, `config`, `config_hash`, `seed`, `versions`,
`fingers` and `joints`, and a group `/grasps`. Values that a posture or a stage did not reach are
NaN, 0, false or empty; "from" names the stage from which a value exists. Equal input produces equal
bytes.
"""

_ROWS = """
If the grasps belong to rows of a dataset, a further group `/rows` identifies these rows, with the
attributes `split`, `camera` and `shards` of the data file:
"""

_LINES = """
Without `--out`, or with `--json`, one JSON object per line goes to standard output, with the same
fields, in the same units. NaN, inf and what was not reached become `null`, outcomes and filters are
named, and poses are 4 x 4 matrices. Further keys are `index`, the grasp's position in the input;
`outcomes` of all tried wrist poses; `unjudged`, the filters that a verdict cannot apply; `explain`,
the verdict in sentences; and `seconds`, the wall-clock time by stage.
"""

_SHARDS = """
## Shards

A shard has `/trials` as above without `trial_id` and `object`, and `/looks` with one row per
success:
"""


#: What introduces a table of fields, the fields, and whether the stage is told from which they
#: have values.
_TABLES = (
    (_DATA, schema.DATA_FIELDS, False),
    ("\n## trials.hdf5\n\n### /trials\n", schema.TRIAL_FIELDS, True),
    ("\n### /objects\n", schema.OBJECT_FIELDS, False),
    ("\n### /successes\n", schema.SUCCESS_FIELDS, False),
    (_SCENES, schema.SCENE_FIELDS, False),
    ("\n### /views\n", schema.VIEW_FIELDS, False),
    ("\n### /grasps\n", schema.SCENE_GRASP_FIELDS, False),
    ("\n### /visible\n", schema.VISIBLE_FIELDS, False),
    ("\n### /objects of scenes.hdf5\n", schema.SCENE_OBJECT_FIELDS, False),
    (_REACH, schema.REACH_FIELDS, False),
    ("\n### /shapes\n", schema.SHAPE_FIELDS, False),
    (_CLUTTER_REACH, schema.CLUTTER_REACH_FIELDS, False),
    (_SHARDS, schema.LOOK_FIELDS, False),
    (_VERIFICATION, schema.VERIFICATION_FIELDS, True),
    (_ROWS, schema.PREDICTED_ROW_FIELDS, False),
)


def format_page() -> str:
    """Return the page as Markdown."""
    conventions = "## Conventions\n\nThey are in every file as attributes `convention_*`.\n"
    parts = [_HEAD, conventions, _table(("attribute", "text"), schema.CONVENTIONS.items())]
    parts.append(_ATTRIBUTES)
    for head, fields, stages in _TABLES:
        parts += [head, _fields(fields, stages=stages)]
    return "\n".join([*parts, _LINES, "\n" + _CONTRACT])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script, see `generated_page`."""
    return generated_page.main(format_page(), __doc__.splitlines()[0], argv)


def _fields(fields: Sequence[schema.Field], *, stages: bool = False) -> str:
    """Return the table of some fields, on request with the stage from which they have values."""
    heads: tuple[str, ...] = ("field", "shape", "type", "unit", "frame", "meaning")
    rows = []
    for field in fields:
        # Shapes as NumPy writes them: (N,), (N, 3).
        axes = ", ".join(["N", *map(str, field.axes)])
        shape = f"({axes})" if field.axes else f"({axes},)"
        cells = [f"`{field.name}`", shape, field.dtype, field.unit, field.frame, field.meaning]
        if stages:
            cells.insert(5, field.stage.name.lower())
        rows.append(cells)
    if stages:
        heads = (*heads[:5], "from", heads[5])
    return _table(heads, rows)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
