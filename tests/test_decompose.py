"""Convex pieces enclose the surface of a mesh, and little else."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from test_shapes import SHELF, boards

from qpavoid.geometry.decompose import decompose


def indexed(triangles):
    vertices, index = np.unique(triangles.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


def torus(around=24, across=6, big=0.3, small=0.06):
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, around + 1), np.linspace(0, 2 * np.pi, across + 1), indexing="ij")
    r = big + small * np.cos(b)
    grid = np.stack((r * np.cos(a), r * np.sin(a), small * np.sin(b)), axis=-1)
    quads = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate(
        (np.stack(quads[:3], axis=2).reshape(-1, 3, 3), np.stack((quads[0], *quads[2:]), axis=2).reshape(-1, 3, 3))
    )


def bracket():
    """A U profile, one closed surface."""
    outline = np.array([(0, 0), (1, 0), (1, 1), (0.9, 1), (0.9, 0.1), (0.1, 0.1), (0.1, 1), (0, 1)], dtype=float)
    low, high = np.c_[outline, np.zeros(8)], np.c_[outline, np.full(8, 0.5)]
    faces = [[low[i], low[j], high[j]] for i, j in ((i, (i + 1) % 8) for i in range(8))]
    faces += [[low[i], high[j], high[i]] for i, j in ((i, (i + 1) % 8) for i in range(8))]
    for a, b, c, d in ((0, 1, 4, 5), (1, 2, 3, 4), (0, 5, 6, 7)):
        faces += [[high[a], high[b], high[c]], [high[a], high[c], high[d]]]
        faces += [[low[a], low[c], low[b]], [low[a], low[d], low[c]]]
    return np.array(faces)


def outside(points, pieces):
    """How far points (n, 3) lie outside the union of the pieces' hulls."""
    depths = []
    for piece in pieces:
        equations = ConvexHull(piece).equations
        depths.append((points @ equations[:, :3].T + equations[:, 3]).max(axis=1))
    return np.min(depths, axis=0)


MESHES = {"shelf": boards(*SHELF), "bracket": bracket(), "torus": torus()}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("most", [1, 16])
def test_pieces_enclose_the_surface(name, most):
    triangles = MESHES[name]
    pieces = decompose(*indexed(triangles), most, 0.02)
    assert 1 <= len(pieces) <= most
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(3), size=(len(triangles), 20))
    points = np.einsum("tpc,tcx->tpx", weights, triangles).reshape(-1, 3)
    assert outside(points, pieces).max() < 1e-9 * np.ptp(triangles.reshape(-1, 3), axis=0).max()


def test_boards_and_profiles_come_out_exactly():
    volume = [sum(ConvexHull(p).volume for p in decompose(*indexed(MESHES[n]), 16, 0.02)) for n in ("shelf", "bracket")]
    assert volume[0] == pytest.approx(3 * 0.8 * 0.3 * 0.02 + 2 * 0.02 * 0.3 * 0.74, rel=0.02)
    assert volume[1] == pytest.approx(0.5 * (0.1 + 2 * 0.09), rel=1e-6)
    assert len(decompose(*indexed(MESHES["bracket"]), 16, 0.02)) == 3


def test_a_ring_keeps_its_hole():
    pieces = decompose(*indexed(MESHES["torus"]), 16, 0.02)
    assert outside(np.zeros((1, 3)), pieces)[0] > 0.12


def test_faces_may_look_inwards():
    assert len(decompose(*indexed(MESHES["bracket"][:, ::-1]), 16, 0.02)) == 3


def test_convex_meshes_stay_whole_and_flat_ones_are_one_piece():
    box = boards(((0, 0, 0), (1.0, 2.0, 3.0)))
    assert len(decompose(*indexed(box), 16, 0.02)) == 1
    sheet = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], dtype=float)
    assert len(decompose(*indexed(sheet), 16, 0.02)) == 1
