from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout, SensorLayout, transmission
from srtomo_core.system import System, Telescope, load_system
from srtomo_srtc.geometry import Lattice, cell_light
from srtomo_srtc.gradient import GradientOperator, Stencils, gradient_operator


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _local(sensor: SensorLayout, operator: GradientOperator) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in the sensor's own axes."""
    x, y = operator.x - sensor.shift[0], operator.y - sensor.shift[1]
    c, s = np.cos(sensor.rotation), np.sin(sensor.rotation)
    return c * x + s * y, c * y - s * x


def test_a_lit_subaperture_has_the_paper_s_stencil(mini: System) -> None:
    place = Layout(mini).sensors[0]
    operator = gradient_operator(Telescope(diameter=100.0, obscuration=0.0), place)
    x, y = _local(place, operator)
    i = int(np.argmin(np.hypot(*place.local.T)))
    expected = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 4 / place.size
    for row, stencil in ((i, expected), (i + place.n_valid, expected.T)):
        for column, weight in zip(*operator.matrix[[row]].nonzero()[1:], operator.matrix[[row]].data):
            at = (
                np.rint(2 * (y[column] - place.local[i, 1]) / place.size),
                np.rint(2 * (x[column] - place.local[i, 0]) / place.size),
            )
            assert weight == pytest.approx(stencil[int(at[0]) + 1, int(at[1]) + 1])
        assert operator.matrix[[row]].nnz == 6


@pytest.mark.parametrize("oversampling", [1, 2, 4])
def test_a_lit_subaperture_at_any_oversampling(mini: System, oversampling: int) -> None:
    # the mean gradient over a square of a bilinear phase: differences of opposite sides, by the trapezoidal rule
    place = Layout(mini).sensors[0]
    operator = gradient_operator(Telescope(diameter=100.0, obscuration=0.0), place, oversampling)
    x, y = _local(place, operator)
    i = int(np.argmin(np.hypot(*place.local.T)))
    side = np.ones(oversampling + 1)
    side[[0, -1]] = 0.5
    side /= side.sum() * place.size
    row = operator.matrix[[i]]
    for column, weight in zip(row.nonzero()[1], row.data):
        along_y = round(oversampling * ((y[column] - place.local[i, 1]) / place.size + 0.5))
        along_x = (x[column] - place.local[i, 0]) / place.size
        assert along_x == pytest.approx(0.5 * np.sign(weight))
        assert abs(weight) == pytest.approx(side[along_y])
    assert row.nnz == 2 * len(side)
    # the lattice is the same nodes
    np.testing.assert_allclose(np.stack(operator.lattice.points()), [operator.x, operator.y], atol=1e-12)
    rows = operator.lattice.to_steps(operator.x, operator.y)
    np.testing.assert_allclose(rows, np.stack([operator.lattice.row, operator.lattice.column], axis=1), atol=1e-9)


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.35, -0.2), (-0.61, 0.43), (0.9, 0.8)])
@pytest.mark.parametrize("threshold", [0.02, 0.5])
def test_ramps_and_piston_under_any_illumination(mini: System, centre: tuple[float, float], threshold: float) -> None:
    system = mini.with_changes(
        {
            "telescope.obscuration_centre": centre,
            "sensors.*.illumination_threshold": threshold,
            "sensors.3.rotation": 0.3,
            "telescope.spiders": [{"width": 0.15, "angle": 0.4}, {"width": 0.15, "angle": 2.0}],
        }
    )
    for place in Layout(system).sensors:
        operator = gradient_operator(system.telescope, place)
        c, s, ones = np.cos(place.rotation), np.sin(place.rotation), np.ones(place.n_valid)
        for wavefront, along_x, along_y in (
            (operator.x, c, -s),
            (operator.y, s, c),
            (np.ones_like(operator.x), 0.0, 0.0),
        ):
            expected = np.concatenate([along_x * ones, along_y * ones])
            np.testing.assert_allclose(operator.matrix @ wavefront, expected, atol=1e-12)


def test_a_twisted_wavefront_shows_where_the_light_is(mini: System) -> None:
    # x y is bilinear, so the operator is exact: the mean of its gradient (y, x) is the centroid of the light
    for place in Layout(mini).sensors[:3]:
        operator = gradient_operator(mini.telescope, place)
        x, y = _local(place, operator)
        light = transmission(mini.telescope, *place.points(32)).reshape(place.n_valid, -1)
        step = place.size * ((np.arange(32) + 0.5) / 32 - 0.5)
        fine_y, fine_x = (g.ravel() for g in np.meshgrid(step, step, indexing="ij"))
        expected = np.concatenate(
            [
                place.local[:, 1] + light @ fine_y / light.sum(axis=1),
                place.local[:, 0] + light @ fine_x / light.sum(axis=1),
            ]
        )
        np.testing.assert_allclose(operator.matrix @ (x * y), expected, atol=1e-12)


def test_a_whole_pupil_sensor_averages_over_the_light(mini: System) -> None:
    place = Layout(mini).sensors[3]
    operator = gradient_operator(mini.telescope, place)
    nodes = np.stack([operator.x, operator.y], axis=1)
    apart = np.sort(np.hypot(*(nodes[:, None] - nodes[None, :]).T), axis=0)[1]
    assert apart.max() < 0.26
    wavefront = np.sin(1.5 * operator.x + 0.4) * np.cos(0.8 * operator.y)
    x, y = (p.ravel() for p in place.points(400))
    light = transmission(mini.telescope, x, y)
    expected = [
        light @ (1.5 * np.cos(1.5 * x + 0.4) * np.cos(0.8 * y)) / light.sum(),
        light @ (-0.8 * np.sin(1.5 * x + 0.4) * np.sin(0.8 * y)) / light.sum(),
    ]
    np.testing.assert_allclose(operator.matrix @ wavefront, expected, rtol=0.02)


def test_a_dark_subaperture_is_refused(mini: System) -> None:
    place = replace(Layout(mini).sensors[0], shift=(2.0, 0.0))
    with pytest.raises(ValueError, match=r"sensor lgs1: sub-aperture .* is dark"):
        gradient_operator(mini.telescope, place)


def _together(stencils: Stencils, lattice: Lattice) -> np.ndarray:
    """(n_slopes, n_nodes) of what was taken apart."""
    number = {node: i for i, node in enumerate(zip(lattice.row.tolist(), lattice.column.tolist()))}
    out = np.zeros((stencils.n_slopes, len(number)))
    for stencil in stencils.shared:
        for slope, (row, column) in zip(stencil.slopes, stencil.place):
            nodes = zip((row + stencil.row).tolist(), (column + stencil.column).tolist())
            out[slope, [number[node] for node in nodes]] += stencil.weights
    nodes = zip(stencils.lattice.row.tolist(), stencils.lattice.column.tolist())
    out[np.ix_(stencils.others, [number[node] for node in nodes])] += stencils.matrix.toarray()
    return out


@pytest.mark.parametrize("oversampling", [1, 2, 4])
def test_stencils_are_the_operator(mini: System, oversampling: int) -> None:
    for place in Layout(mini).sensors:
        operator = gradient_operator(mini.telescope, place, oversampling)
        together = _together(operator.stencils, operator.lattice)
        np.testing.assert_allclose(together, operator.matrix.toarray(), rtol=0, atol=1e-11)
        # all that are fully lit share one, and a sensor of few sub-apertures has none
        lit = int((place.illumination == 1).sum())
        assert sum(len(stencil.slopes) for stencil in operator.stencils.shared) >= (2 * lit if lit > 8 else 0)
        assert len(operator.stencils.shared) == (2 if lit > 8 else 0)


def test_sub_apertures_far_from_any_edge_need_no_look_at_the_pupil(mini: System) -> None:
    telescope = mini.telescope.model_copy(
        update={
            "spiders": load_system(
                "mini", {"telescope.spiders": [{"angle": "30 deg", "width": "5 cm"}]}
            ).telescope.spiders
        }
    )
    place, cells, fine = Layout(mini).sensors[1], 2, 6
    points = transmission(telescope, *place.points(cells * fine)).reshape(-1, cells, fine, cells, fine)
    lit, at = points.mean(axis=(2, 4)), (np.arange(fine) + 0.5) / fine
    light, u, v = cell_light(telescope, place, cells, fine)
    assert np.array_equal(light, lit) and (light == 1).sum() > 100 and 0 < (light < 1).sum()
    some = lit > 0
    assert u[some] == pytest.approx(((points * at).mean(axis=(2, 4)) / np.where(some, lit, 1))[some], abs=1e-14)
    assert v[some] == pytest.approx(
        ((points * at[:, None, None]).mean(axis=(2, 4)) / np.where(some, lit, 1))[some], abs=1e-14
    )
    assert not u[~some].any() and not v[~some].any()
