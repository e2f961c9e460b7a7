"""What a view shows of an object becomes a closed surface, less what is seen to be free."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.depth_images import BOX, box_view, cloud_of

from drakegrasp.errors import TooLittleSeenError
from drakegrasp.mesh.cloud import column_solid, hull_solid, read_cloud
from drakegrasp.mesh.surfaces import is_solid_surface
from drakegrasp.vision.depth_image import complete


@pytest.fixture(scope="module")
def view():
    """A box of 80 x 60 x 100 mm, with unknown pixels on it and beside it."""
    return box_view()


@pytest.fixture(scope="module")
def cloud(view):
    return read_cloud(cloud_of(view))


def mesh_of(solid):
    assert is_solid_surface(solid.faces)
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


@pytest.mark.parametrize("guess", [hull_solid, column_solid])
@pytest.mark.parametrize("seen", [True, False])
def test_a_box_becomes_about_itself_on_the_table(view, cloud, guess, seen):
    mesh = mesh_of(complete(guess(cloud).field, view if seen else None))
    low, high = mesh.bounds
    assert low[2] == pytest.approx(0.0, abs=1e-4)
    np.testing.assert_allclose(high, BOX, atol=4e-3)
    # Nothing of the back is seen; its edges are those of the top.
    np.testing.assert_allclose(low[:2], -BOX[:2], atol=5e-3)
    # The columns are hollow, since few points of the top are seen from so low a camera.
    full = float(np.prod(2.0 * BOX * [1.0, 1.0, 0.5]))
    assert mesh.volume == pytest.approx(full if guess is hull_solid else 0.5 * full, rel=0.12)


def test_free_space_of_a_view_is_cut_from_a_hull(view, cloud):
    """A point far beside the box widens the hull; the view shows table there."""
    wide = np.concatenate([cloud, [[0.0, 0.12, 0.0]]])
    hull, cut = (mesh_of(complete(hull_solid(wide).field, v)) for v in (None, view))
    assert hull.bounds[1][1] > 0.1
    assert cut.bounds[1][1] == pytest.approx(BOX[1], abs=6e-3)
    # An image without depth beside the box shows nothing free there.
    blind = view._replace(depth=np.where(view.mask, view.depth, np.nan))
    assert mesh_of(complete(hull_solid(wide).field, blind)).bounds[1][1] > 0.1
    # What stands between camera and table hides what is behind it.
    before = view._replace(depth=np.where(view.mask, view.depth, 0.2))
    assert mesh_of(complete(hull_solid(wide).field, before)).bounds[1][1] > 0.1


def test_a_solid_that_is_free_everywhere_is_told(view, cloud):
    behind = view._replace(depth=np.full_like(view.depth, 5.0))
    with pytest.raises(TooLittleSeenError, match="cloud must show a solid, got one"):
        complete(hull_solid(cloud).field, behind)
