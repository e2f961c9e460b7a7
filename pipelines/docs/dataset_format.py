"""Write docs/reference/dataset-format.md from the schema table, or check that it is up to date.

Usage: python pipelines/docs/dataset_format.py [--check] FILE
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

import generated_page

from drakegrasp.dataset.schema import (
    CONVENTIONS,
    DATA_FIELDS,
    LOOK_FIELDS,
    OBJECT_FIELDS,
    PREDICTED_ROW_FIELDS,
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SCENE_OBJECT_FIELDS,
    SCHEMA_VERSION,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    VERIFICATION_FIELDS,
    VIEW_FIELDS,
    VISIBLE_FIELDS,
    Field,
)

_HEAD = f"""<!-- Made by `make docs-pages` from dataset/schema.py: change that, not this. -->

# The dataset's format

Schema version {SCHEMA_VERSION}. In the shapes `N` is the number of rows, `k` of fingers, `j` of
the hand's joints, `6k` the length of a grasp (18 for three fingers) and `S` the size of the images;
in `scenes.hdf5` `h` and `w` are those of its images, and `o` is the number of objects in a scene.
Frames are explained in [frames-and-units.md](frames-and-units.md). Every dataset of a file carries
its `unit`, `frame` and `meaning` as attributes; one of joints (`j`) also has the names of its
`joints`, in JSON.

```
OUT/
  manifest.json            configuration, its hash, seed, versions, objects, refused meshes
  hand/                    the hand: hand file, model, meshes, weights of lifts, licences
  objects/NAME.npz         an object: meshes, mass, centre of mass, inertia
  objects/NAME.plan.h5     its resting pose and palm poses
  shards/NAME/RANGE.h5     what one work unit found; immutable
  trials.hdf5              a row per attempt, whatever its outcome
  grasping_oto.hdf5        samples, camera rolled with the palm
  grasping_otm.hdf5        the same samples, image up is world up
  scenes.hdf5              views that do not depend on a grasp, with all closed hands; if asked for
  DATACARD.md, .json       what it is, how it was made, counts, licences, known limits
  log.jsonl                what happened while it was built, and when: a line of JSON per event
  reject.json              grasps that an inspection rejects; only if there was one
  build.lock               while a build runs: by which process
```

The data card is written with the three files, and `drakegrasp check` compares its counts with
them. It has no time and no machine in it: equal files have equal cards.

A changed bit shows when a file is read: `sha256` in the manifest is the hash of its other keys,
shards and plans have a seal, and the HDF5 files have checksums of their columns and of where these
lie. Texts of HDF5 (names, attributes) have none: `check` compares them.

Only the data files, `grasping_*.hdf5`, are needed to train. With `objects/`, `hand/` and
`manifest.json`, every trial can be replayed.

`hand/` is copied when a build begins, and read by workers and by every later command. Files below
the hand file keep their places and bytes. A model that names files by an absolute path, by
one that leads out of its folder, or by `package://`, is rewritten: these files are in
`hand/files/`. `versions` in the manifest has a digest of hand file, model, weights and meshes,
without their paths: a build continues with a hand of the same digest, wherever it is and whatever
its file is called, `merge` demands the same digest, and `check` compares it. Datasets of version
0.2 and before have no `hand/`: a hand of the package is then the installed one, and a hand file is
read at its path; a build that continues adds it.
"""

_CONTRACT = """## What makes two files equal

The same command gives the same arrays, whatever the number of workers, in which order they work
and how often the build was interrupted: nothing in these files depends on the clock or the
machine's name. `time_close` and `time_lift` are simulated seconds. This holds on one machine with
one set of library versions (`manifest.json` names them); another CPU or another version of Drake
may round differently. The exceptions are the outcomes `timeout` and `crashed`: an attempt that
computes for longer than `attempt_seconds` (60 s, where a usual one takes about one), or ends its
process again and again, says more about the machine than about the grasp, and may end otherwise
elsewhere.
`screened` is an attempt that geometry has decided: it was not simulated, and would have been a
`missing_fingertip`, see [screening](../explanation/screening.md).

## Where closing ends

`time_close` and all that begins with `closed_` are of the moment at which closing ended. Mostly all
fingers stand still then. Closing ends before that as soon as one finger has passed the last angle
at which it can meet the object: the verdict is `missing_fingertip` then, whatever the others do. So
in rows of `missing_fingertip` other fingers may still be on their way, and `closed_q` is no closed
hand.

While the hand closes the object is fixed in its place. So no column says whether it stands on the
table then, and the forces of the fingertips need not balance.

## Versions of the schema

Files of the `schema_version` above are read. Any other version is refused with a line that names
the file and both versions: build the dataset again, in another directory. Version 4 came with
resting poses, sampler, refined palm poses, weights, chance and audit. Version 2 had no conditions
of an attempt, and no mass, density, friction, scale and axis of each object. Version 1 also
had other labels: fingers that the object pushed open, and contacts anywhere on a fingertip's link.

## Seals

Shards and the files in `objects/` are sealed: a changed bit in one of them is found when it is
used, and by `drakegrasp check`. The three main files have no seal: `check` finds what breaks an
invariant, not every changed bit of an image. `drakegrasp assemble` makes them again from the
shards; a build does so by itself if they are not of the present shards and manifest. A list of
rejected trials (`assemble --reject`) is kept in the manifest until the next `assemble`.

The three files and the manifest are replaced together: while `replacement.json` is in the directory
they are of two states, and every reader refuses them. The next command with OUT completes this.

## A stranger's dataset

A dataset may come from anywhere. No link in its directory is followed when something is written or
deleted. An HDF5 file that has soft or external links, values in another file or more rows than its
bytes can hold is refused, and so are pipes, devices and files that are too large for what they
should be; a link to a file is followed to read it, as the cache of a hub needs. Names of objects
are names: printable, without slashes. What the hand in `hand/` names lies there: links that lead
out, other paths and more than 512 MB are refused. Control characters reach no terminal, log or
page.

## Missing values

The two data files hold no NaN. In `trials.hdf5` a value that does not exist for a row is NaN
(floats), 0 or false: the column "from" above says with which stage a value begins. Contact points
and normals, and how they fit the mesh, are also NaN for a finger that does not touch. The stage of
a row follows from its outcome: `success`, `slipped`, `partly_held`, `dropped` and `moved` were
lifted;
`missing_fingertip` and `hand_contact` were closed; `table_contact` was closed, and lifted if
`time_lift` is a number (then it is the object that still touches the table, or the hand that
scraped it in the lift); all others were only
placed. "After the lift" is when it ended: of `moved`, the moment at which it was ended.
`solver_error`, `timeout` and `crashed` say that the simulator failed: never count them as failed
grasps. `moved` says that the attempt is no sample, not that the hand would have lost the object.
"""


_ATTRIBUTES = """
Further attributes: `schema_version`, `camera` and `split_by` (`class` or `object`) of the data
files, camera matrix `K` [px], `near` and `far` [m], `config` and `versions` (JSON), `config_hash`,
`seed`, the names of the hand's `fingers` and `joints` in their order (JSON), and of what the file
was assembled from: `signature`, a hash of all in the manifest that decides a row, and `shards`, a
hash of their seals.
"""

_DATA = """## grasping_oto.hdf5 and grasping_otm.hdf5

Groups `/train`, `/valid` and `/test` have the same fields; images and masks are stored in one
chunk per sample, gzip 1 with shuffle. Successes only, after the filters.

A sample has two grasps. `grasps` are the contacts where closing ended, on the object before it is
freed. `grasps_held` are those at the end of the lift, where the object may have moved in the hand;
they are drawn on the object in its resting pose, as if hand and object were put back together. All
names that end in `_held` are of that instant, in that way. `grasp_props/` says how well the hand
holds; its words are explained in [outcomes](outcomes.md#held-precision-stable). `conditions/` are
the values in use, drawn for the attempt or not, see
[randomisation](../explanation/randomization.md).
"""

_SCENES = """
## scenes.hdf5

`drakegrasp scenes` makes it, see [training on scenes](../how-to/train-on-scenes.md). A scene is an
object in a resting pose, somewhere on the table; all cameras of a scene have its colours and its
light, and each its own noise of depth. The file has the attributes of `trials.hdf5` but `K`; `near`
and `far` are those of its cameras. Images are stored in one chunk each, gzip 1. Unlike in the data
files, what was not lifted is NaN.

### /scenes
"""

_VERIFICATION = """
## The results of `drakegrasp verify`

`drakegrasp verify ... --out NAME` writes two files, with a row or a line per grasp in the order of
the input. `NAME.h5` has the attributes `convention_*`, `schema_version`, `config`, `config_hash`,
`seed`, `versions`, `fingers` and `joints`, and a group `/grasps`. What a method or a stage did not
reach is NaN, 0, false or empty; "from" says with which stage a value begins. Equal input gives
equal bytes.
"""

_ROWS = """
Where the grasps are for rows of a dataset, a further group `/rows` says which, with the
attributes `split`, `camera` and `shards` of the data file:
"""

_LINES = """
`NAME.jsonl`, or standard output without `--out`, has a JSON object per line; NaN and inf are
`null`. `index` is the grasp's place in the input, `success` whether it holds, `outcome` the label
of the verdict, `explain` the verdict in sentences, `X_OG` a 4 x 4 matrix. `solver` (SLSQP's
`status`, `message`, `iterations`), `closed` and `lifted` (contacts then) and `forces` (method
`forces`: shares, and the contacts of the surface that were selected) are objects, or `null` if they
were not reached; `seconds` is the wall clock by stage.
Angles that end in `_deg` are in degrees; all else is as in the table, in its units.
"""

_SHARDS = """
## Shards

`/trials` as above without `trial_id` and `object`, and `/looks` with a row per success:
"""


def format_page() -> str:
    """Return the page as Markdown."""
    return "\n".join(
        [
            _HEAD,
            "## Conventions\n\nThey are in every file as attributes `convention_*`.\n",
            _table(("attribute", "text"), CONVENTIONS.items()),
            _ATTRIBUTES,
            _DATA,
            _fields(DATA_FIELDS),
            "\n## trials.hdf5\n\n### /trials\n",
            _fields(TRIAL_FIELDS, stages=True),
            "\n### /objects\n",
            _fields(OBJECT_FIELDS),
            "\n### /successes\n",
            _fields(SUCCESS_FIELDS),
            _SCENES,
            _fields(SCENE_FIELDS),
            "\n### /views\n",
            _fields(VIEW_FIELDS),
            "\n### /grasps\n",
            _fields(SCENE_GRASP_FIELDS),
            "\n### /visible\n",
            _fields(VISIBLE_FIELDS),
            "\n### /objects of scenes.hdf5\n",
            _fields(SCENE_OBJECT_FIELDS),
            _SHARDS,
            _fields(LOOK_FIELDS),
            _VERIFICATION,
            _fields(VERIFICATION_FIELDS, stages=True),
            _ROWS,
            _fields(PREDICTED_ROW_FIELDS),
            _LINES,
            "\n" + _CONTRACT,
        ]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script, see `generated_page`."""
    return generated_page.main(format_page(), __doc__.splitlines()[0], argv)


def _fields(fields: Sequence[Field], *, stages: bool = False) -> str:
    """Return the table of some fields, with the stage from which they have values if asked for."""
    heads: tuple[str, ...] = ("field", "shape", "type", "unit", "frame", "meaning")
    rows = []
    for field in fields:
        # As NumPy writes it: (N,), (N, 3).
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
