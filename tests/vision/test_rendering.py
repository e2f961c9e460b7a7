"""What the renderer sees of a box, by closed forms: depth, outline, and the same bits again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from helpers.machine import needs_egl
from helpers.meshes import box_distance
from helpers.objects import model_of

from drakegrasp.config import CameraConfig
from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.file_format import MODELS
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import (
    TABLE_COLOUR,
    Appearance,
    intrinsics,
    object_colour,
    project,
    unproject,
    usual_appearance,
)
from drakegrasp.vision.rendering import (
    RenderedView,
    Renderer,
    build_renderer,
    depth_in_box,
    paint,
    render,
)

pytestmark = [pytest.mark.sim, needs_egl]

CONFIG = CameraConfig()
K = intrinsics(CONFIG)
#: Full extents of the box [m], standing on the table.
EXTENTS = np.array([0.06, 0.08, 0.10])
HALF = EXTENTS / 2.0
X_TO = make_pose(np.eye(3), [0.0, 0.0, HALF[2]])
#: On the side towards +Oy.
LYING = make_pose([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0.0, 0.0, HALF[1]])
#: Columns are the camera's axes in {T}: looking along -x, from +x, world up on top.
R_FROM_X = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
#: Looking along -y, from +y, world up on top.
R_FROM_Y = np.column_stack([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
#: Looks unlike the usual ones in everything.
GARISH = Appearance(
    object_colour=np.array([0.1, 0.9, 0.2]),
    table_colour=np.array([0.8, 0.1, 0.7]),
    light_direction=np.array([-0.6, 0.0, -0.8]),
    light_strength=0.3,
)
#: Looking straight down, +Ty on top.
R_FROM_ABOVE = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return model_of(trimesh.creation.box(EXTENTS), tmp_path_factory.mktemp("mesh"), "box")


@pytest.fixture(scope="module")
def renderer(box: ObjectModel) -> Renderer:
    return build_renderer(box, CONFIG)


def facing_x(distance: float) -> Array:
    """Return X_TC of a camera `distance` in front of the box's +x face, level with its centre."""
    return make_pose(R_FROM_X, [HALF[0] + distance, 0.0, HALF[2]])


#: A camera above a corner that sees three faces and the table.
def oblique() -> Array:
    p_TC = np.array([0.18, 0.14, 0.25])
    z = X_TO[:3, 3] - p_TC
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), p_TC)


def object_points(seen: RenderedView, X_TC: Array, X_TO: Array) -> Array:
    """Return p_OQ (n, 3) of the mask's pixels, unprojected with their depth."""
    rows, columns = np.nonzero(seen.mask)
    p_CQ = unproject(K, np.column_stack([columns, rows]), seen.image[3][rows, columns])
    return transform_points(invert_pose(X_TO) @ X_TC, p_CQ)


@pytest.mark.parametrize("distance", [0.15, 0.25, 0.5])
def test_face_seen_squarely_has_its_depth_and_outline(renderer: Renderer, distance: float) -> None:
    """Depth is z, not range. Edges of f w / d pixels, to a pixel, centred: y right, z up."""
    seen = render(renderer, X_TO, facing_x(distance))
    mask = seen.mask
    rows, columns = np.nonzero(mask)
    np.testing.assert_allclose(seen.image[3, 63:65, 63:65], distance, atol=1e-4)
    np.testing.assert_allclose(seen.image[3][rows, columns], distance, atol=1e-4)
    for pixels, edge in ((columns, EXTENTS[1]), (rows, EXTENTS[2])):
        assert abs((pixels.max() - pixels.min() + 1) - K[0, 0] * edge / distance) <= 1.0
        assert abs((pixels.max() + pixels.min()) / 2.0 - 63.5) <= 1.0
    # A face seen squarely fills its rectangle.
    assert mask.sum() == (np.ptp(columns) + 1) * (np.ptp(rows) + 1)


def test_mask_has_no_bias(renderer: Renderer) -> None:
    """The middle of the mask is the face's projection, on average over parts of a pixel."""
    errors = []
    for k in range(20):
        X_TC = facing_x(0.25)
        X_TC[1:3, 3] += np.array([2e-4, 2.6e-4]) * k
        rows, columns = np.nonzero(render(renderer, X_TO, X_TC).mask)
        middle = [(columns.min() + columns.max()) / 2.0, (rows.min() + rows.max()) / 2.0]
        errors.append(middle - project(K, [[-2e-4 * k, 2.6e-4 * k, 0.25]])[0])
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.15)


def test_pixels_beyond_the_table_hold_far(renderer: Renderer) -> None:
    """Level with the table there is no table above the horizon: exactly `far`, in float32."""
    seen = render(renderer, X_TO, facing_x(0.25))
    assert (seen.image[3][:20] == np.float32(CONFIG.far)).all() and not seen.mask[:20].any()
    assert seen.image[3].max() == np.float32(CONFIG.far)
    # An object beyond it is not seen.
    seen = render(renderer, X_TO, facing_x(0.8))
    assert not seen.mask.any()
    np.testing.assert_array_equal(seen.image[3, 63:65, 63:65], np.float32(CONFIG.far))


@pytest.mark.parametrize("X_TO", [X_TO, LYING], ids=["standing", "lying"])
def test_mask_and_depth_agree(renderer: Renderer, X_TO: Array) -> None:
    """Pixels of the mask, unprojected, lie on the box; all others lie off it."""
    X_TC = oblique()
    seen = render(renderer, X_TO, X_TC)
    assert 500 < seen.mask.sum() < 128 * 128 / 2
    assert np.abs(box_distance(object_points(seen, X_TC, X_TO), HALF)).max() < 1e-6
    inverted = object_points(replace(seen, mask=1 - seen.mask), X_TC, X_TO)
    # The table's pixels at the foot of the box come near to it.
    assert np.median(box_distance(inverted, HALF)) > 0.02
    assert box_distance(inverted, HALF).min() > -1e-6
    assert abs(np.median(transform_points(X_TO, inverted)[:, 2])) < 1e-4  # most are on the table
    # Types and ranges are those of the files.
    assert (seen.image.dtype, seen.mask.dtype) == (np.float32, np.uint8)
    assert 0.0 <= seen.image[:3].min() < seen.image[:3].max() <= 1.0


def test_depth_beyond_the_box_moves_along_its_ray() -> None:
    """A camera looks down on the box's lid from 0.25 m; each pixel is 10 mm from the next there."""
    lens = np.array([[25.0, 0.0, 2.0], [0.0, 25.0, 0.0], [0.0, 0.0, 1.0]])
    X_OC = make_pose(R_FROM_ABOVE, [0.0, 0.0, HALF[2] + 0.25])
    # Above the lid, on it, inside, below the floor, too near, nothing, where the ray misses it.
    given = np.array([[0.24, 0.25, 0.3, 0.36, 0.0, np.inf, 0.26]], dtype=np.float32)
    mask = np.ones_like(given, dtype=np.uint8)
    found = depth_in_box(given, mask, lens, X_OC, HALF)
    expected = [0.25, 0.25, 0.3, 0.35, 0.0, np.inf, 0.26]
    np.testing.assert_allclose(found[0], expected, rtol=0.0, atol=1e-7)
    # A fault of another kind stays, for `check` to name.
    far = given - np.float32(0.1)
    assert depth_in_box(far, mask, lens, X_OC, HALF)[0, 0] == far[0, 0]
    # Nothing moves behind the camera: here it looks away from the lid, 5 mm above it.
    away = make_pose(np.eye(3), [0.0, 0.0, HALF[2] + 0.005])
    near = np.full_like(given, 0.01)
    np.testing.assert_array_equal(depth_in_box(near, mask, lens, away, HALF), near)
    # What is not of the object stays.
    assert depth_in_box(given, 0 * mask, lens, X_OC, HALF) is given


def test_rendered_depths_are_within_the_box(renderer: Renderer) -> None:
    """Told that the object is smaller, the renderer moves the +x face to the smaller box's."""
    seen = render(
        replace(renderer, half_extents=(HALF - [0.005, 0.0, 0.0])[None]), X_TO, facing_x(0.25)
    )
    assert seen.image[3][seen.mask == 1].min() == pytest.approx(0.255, abs=1e-6)


def test_object_has_its_names_colour(renderer: Renderer) -> None:
    """Shading scales a colour and keeps its hue: the channels keep their order."""
    seen = render(renderer, X_TO, oblique())
    colour: npt.NDArray[np.float32] = np.median(seen.image[:3][:, seen.mask == 1], axis=1)
    np.testing.assert_array_equal(np.argsort(colour), np.argsort(object_colour("box")))


def pixels(seen: RenderedView) -> tuple[bytes, bytes]:
    return seen.image.tobytes(), seen.mask.tobytes()


@pytest.fixture
def painted(box: ObjectModel) -> Renderer:
    """A renderer of the box whose looks may change."""
    return build_renderer(box, CONFIG)


def test_table_looks_as_its_model_says(box: ObjectModel) -> None:
    """The constant is what the checks compare with; the model is what is drawn."""
    text = (MODELS / "table.urdf").read_text()
    assert f'<color rgba="{" ".join(f"{c:.2f}" for c in TABLE_COLOUR)} 1.0"/>' in text


def brightness(renderer: Renderer) -> tuple[Array, Array]:
    """Return the mean colour of object and table, (3,) each."""
    seen = render(renderer, X_TO, oblique())
    mask = seen.mask.astype(bool)
    table = ~mask & (seen.image[3] < CONFIG.far)
    return seen.image[:3, mask].mean(axis=1), seen.image[:3, table].mean(axis=1)


def test_painting_changes_the_colours_of_object_and_table(painted: Renderer) -> None:
    red, green = np.array([0.9, 0.05, 0.05]), np.array([0.05, 0.6, 0.05])
    paint(painted, replace(painted.appearance, object_colour=red, table_colour=green))
    thing, table = brightness(painted)
    assert thing[0] > 4.0 * thing[1:].max()
    assert table[1] > 4.0 * table[[0, 2]].max()


def test_light_has_a_direction_and_a_strength(painted: Renderer) -> None:
    def faces() -> tuple[float, float]:
        """Return how bright the faces towards +x and +y are."""
        return tuple(
            float(render(painted, X_TO, make_pose(R, p)).image[:3, 64, 64].mean())
            for R, p in ((R_FROM_X, [0.25, 0.0, HALF[2]]), (R_FROM_Y, [0.0, 0.25, HALF[2]]))
        )  # type: ignore[return-value]

    for first, along in ((0, [-0.8, 0.0, -0.6]), (1, [0.0, -0.8, -0.6])):
        paint(painted, replace(painted.appearance, light_direction=np.array(along)))
        both = faces()
        assert both[first] > 1.2 * both[1 - first]

    # A weaker light makes a darker image.
    _, usual = brightness(painted)
    paint(painted, replace(painted.appearance, light_strength=0.2))
    _, dim = brightness(painted)
    assert np.all(dim < 0.8 * usual)


def test_nothing_remains_of_the_looks_before(painted: Renderer, box: ObjectModel) -> None:
    before = render(painted, X_TO, oblique())
    paint(painted, GARISH)
    after = render(painted, X_TO, oblique())
    # Neither depth nor mask changes.
    assert np.array_equal(before.image[3], after.image[3])
    assert np.array_equal(before.mask, after.mask)
    usual, garish = pixels(before), pixels(after)
    paint(painted, usual_appearance(box.name))
    assert pixels(render(painted, X_TO, oblique())) == usual != garish
    assert pixels(render(build_renderer(box, CONFIG), X_TO, oblique())) == usual
    paint(painted, GARISH)
    assert pixels(render(painted, X_TO, oblique())) == garish
