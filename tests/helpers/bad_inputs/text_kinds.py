"""Bad YAML files and bad options."""

from __future__ import annotations

from helpers.bad_inputs.kinds import ANY_TEXT, Kind, whole_file

#: Texts that are no YAML, or none that anybody reads.
ANY_YAML: tuple[Kind, ...] = (
    *(k for k in ANY_TEXT if k.name not in ("empty", "cut to a tenth", "cut in half", "UTF-16")),
    whole_file("a tab", "a:\n\tb: 1\n"),
    whole_file("an open bracket", "a: [1\n"),
    whole_file("a tag of Python", "!!python/object/apply:os.getcwd []\n"),
    whole_file("two documents", "a: 1\n---\nb: 2\n"),
    whole_file("an alias of nothing", "a: *b\n"),
    whole_file("an alias of itself", "a: &a [*a]\n"),
    whole_file(
        "aliases of aliases",
        _bomb := "\n".join(
            ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
            + [f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 10)}]" for k in range(9)]
        ),
    ),
    whole_file("a key twice", "seed: 1\nseed: 2\n"),
    whole_file("a key that is a list", "? [a]\n: 1\n"),
    whole_file("a key that is a number", "5: 1\n"),
    whole_file("a key that is nothing", "~: 1\n"),
    whole_file("a control character", "seed: \x07\n"),
    whole_file("a text with a null byte", "seed: \x00\n"),
)


_EXTREME = ("", " ", "x", "1.5", "nan", "inf", "1e3", "-1", str(10**30), "9" * 5000, "٣x")
#: Options of `build` with the values that must be refused.
OPTIONS: dict[str, tuple[str, ...]] = {
    "--workers": (*_EXTREME, "0", str(2**31), "1000001"),
    "--candidates": (*_EXTREME, "0"),
    "--seed": (*_EXTREME, str(2**64)),
    "--per-class": (*_EXTREME, "0", "10001"),
    "--objects-seed": (*_EXTREME, str(2**64)),
    "--units": ("", " ", "x", "M", "inch"),
    "--config": ("", " ", "x", ".", "nowhere.yaml", "\x00", "a" * 5000),
    "--manifest": ("", " ", ".", "nowhere.yaml", "a" * 5000),
    "--scheduler": ("", " "),
    "--scheduler-file": ("", " ", ".", "nowhere.json"),
    "--out": ("", " ", "a" * 5000, "\x00"),
    "--objects": ("", " ", "nowhere", "\x00", "a" * 5000),
    "--set": (
        *("", " ", "=", "x", "=1", "seed", "seed=", ".=1", "a..b=1", "physics=5", "physics.=5"),
        *("seed.a=5", "seed=1.5", "seed=-1", f"seed={2**64}", f"seed={'9' * 5000}", "seed=nan"),
        *("seed=[", "seed=!!python/object/apply:os.getcwd []", "seed=&a [*a]", "unit_candidates=0"),
        *("unit_candidates=1e30", "candidates.max=1e300", "candidates.max=" + str(10**30)),
        *("physics.time_step=0", "physics.time_step=nan", "physics.time_step=1e-320"),
        *("physics.friction_hand=1e300", "physics.friction_table=1e300", "objects.mass=1e300"),
        *("objects.mass=1e-320", "objects.max_collision_faces=1e30", "lift.hold_time=1e300"),
        *("settle.max_time=1e300", "settle.drop_height=1e300", "camera.size=1e30"),
        *("camera.distance=1e300", "attempt_seconds=1e300", "attempt_seconds=1e-320"),
        *("robustness.repeats=1e30", "samples=1e30", "builtin.per_class=1e30"),
        *("candidates.jitter_deg=1e300", "candidates.standoffs=[1e300]"),
        *("candidates.global_x_deg=[1e300]", "hand=", "hand=.", "hand=nowhere", "hand=[1]"),
        *("split.valid_fraction=1", "split.train_classes=[5]", "filters.max_slip=-1"),
        *("robustness.share=1e300", "randomize.mass=[2, 1]", "randomize.mass=[1e300, 1e300]"),
        *("randomize.camera_shift=1e300", "lift.height=1e300", "close.speed=1e300"),
    ),
}
#: Options of the submission script under SLURM.
CLUSTER_OPTIONS: dict[str, tuple[str, ...]] = {
    "--workers": (*_EXTREME, "0", "1000001"),
    "--cores": (*_EXTREME, "0", "1000001"),
    "--memory": ("", " ", "x", "-1GB", "nan", "inf", "0", "0GB", "1e400GB", "1e30GB", "٣GB"),
}
#: Ports that `inspect` cannot have.
PORTS = ("", " ", "x", "-1", "65536", "1.5", "nan", "9" * 5000)
