"""What to build: shifts, clockings, asterism or mirror pitch with the least predicted wavefront error (section 1.3).

An evaluation is the residual of the best reconstructor under a still sky with the loop's share of noise: no random
numbers, so that differences of a tenth of a nanometre mean something. Valid sub-apertures come and go as sensors move,
which makes small steps: the search (Nelder-Mead) does without derivatives.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.still_sky import best_wfe, wfe_of

Array = NDArray[np.float64]
Change = Callable[[System, float], dict[str, object]]

_DRAWS = 3  # of directions of a misalignment


@dataclass(frozen=True)
class Variable:
    """One number to choose.

    Attributes:
        name: for people, with the unit of its values.
        low, high: bounds.
        start: where the system is.
        changes: for a system and a value, the dotted keys to set.
    """

    name: str
    low: float
    high: float
    start: float
    changes: Change


def shifts(system: System, reach: float = 0.5) -> list[Variable]:
    """x and y of every sensor with more than one sub-aperture, in sub-apertures, up to ``reach`` either way."""
    variables = []
    for i, sensor in enumerate(system.sensors):
        if sensor.subapertures == 1:
            continue
        for axis, letter in enumerate("xy"):

            def changes(now: System, value: float, i: int = i, axis: int = axis) -> dict[str, object]:
                shift = list(now.sensors[i].shift)
                shift[axis] = value
                return {f"sensors.{i}.shift": tuple(shift)}

            name = f"{sensor.name} shift {letter} [sub-aperture]"
            variables.append(Variable(name, -reach, reach, sensor.shift[axis], changes))
    return variables


def clockings(system: System, reach: float = math.radians(45)) -> list[Variable]:
    """Rotation of every sensor with more than one sub-aperture, in degrees; ``reach`` in rad."""

    def changes(i: int) -> Change:
        return lambda now, value: {f"sensors.{i}.rotation": math.radians(value)}

    return [
        Variable(
            f"{sensor.name} rotation [deg]",
            -math.degrees(reach),
            math.degrees(reach),
            math.degrees(sensor.rotation),
            changes(i),
        )
        for i, sensor in enumerate(system.sensors)
        if sensor.subapertures > 1
    ]


def asterism(system: System, reach: float = 3.0) -> list[Variable]:
    """How far out the laser stars are, as a factor on where the system has them, from 0 to ``reach``."""
    lasers = [(i, star.position) for i, star in enumerate(system.guide_stars) if star.kind == "laser"]

    def changes(now: System, value: float) -> dict[str, object]:
        return {f"guide_stars.{i}.position": {"x": value * p.x, "y": value * p.y} for i, p in lasers}

    return [Variable("asterism [times its size]", 0.0, reach, 1.0, changes)] if lasers else []


def pitch(system: System, reach: float = 2.0) -> list[Variable]:
    """Pitch of each mirror as a factor on the system's, from ``1 / reach`` to ``reach``; as wide, so fewer or more."""

    def changes(i: int, own: float, actuators: int) -> Change:
        return lambda now, value: {
            f"mirrors.{i}.pitch": value * own,
            f"mirrors.{i}.actuators": max(2, math.ceil((actuators - 1) / value - 1e-9) + 1),
        }

    return [
        Variable(f"{m.name} pitch [times its own]", 1 / reach, reach, 1.0, changes(i, layout.pitch, m.actuators))
        for i, (m, layout) in enumerate(zip(system.mirrors, Layout(system).mirrors, strict=True))
    ]


VARIABLES: dict[str, Callable[[System], list[Variable]]] = {
    "shifts": shifts,
    "clockings": clockings,
    "asterism": asterism,
    "pitch": pitch,
}
"""What can be varied, by the name that ``srtomo design --vary`` knows."""


def changed(system: System, variables: Sequence[Variable], values: Sequence[float] | Array) -> System:
    """The system with every variable at its value."""
    for variable, value in zip(variables, values, strict=True):
        system = system.with_changes(variable.changes(system, float(value)))
    return system


class Design(NamedTuple):
    """What a search found.

    Attributes:
        values: (n_variables,) of the best.
        wfe: there, m.
        start_wfe: of the system as it was, m.
        evaluations: how many were made.
    """

    values: Array
    wfe: float
    start_wfe: float
    evaluations: int


class _Enough(Exception):
    """The evaluations allowed are used up."""


def optimise(
    system: System,
    variables: Sequence[Variable],
    *,
    evaluations: int = 200,
    seed: int = 1,
    threads: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> Design:
    """Search from where the system is, and from a random place within the bounds, for the least :func:`best_wfe`.

    Args:
        evaluations: at most; half of them for each start.
        seed: of the random place.
        threads: to compute with, apart from those of the BLAS library.
        progress: called with the share of the evaluations used, 0 to 1.

    Raises:
        ValueError: nothing to vary, or not enough evaluations to do so.
    """
    n = len(variables)
    if n == 0 or evaluations < 2 * (n + 2):
        raise ValueError(f"design: expected something to vary and at least {2 * (n + 2)} evaluations for it")
    low, high = (np.array([getattr(v, side) for v in variables]) for side in ("low", "high"))
    start = np.clip([v.start for v in variables], low, high)
    made = 0
    leading: tuple[float, Array] = (math.inf, start)

    def wfe(values: Array, limit: int) -> float:
        nonlocal made, leading
        if made >= limit:
            raise _Enough
        made += 1
        progress(made / evaluations)
        # what the instrument refuses (a dark sub-aperture, a star in the wrong place) is no design
        try:
            found = best_wfe(changed(system, variables, values), threads=threads)
        except ValueError:
            return math.inf
        if found < leading[0]:
            leading = found, values.copy()
        return found

    start_wfe = wfe(start, evaluations)
    places = [start, np.random.default_rng(seed).uniform(low, high)]
    for k, place in enumerate(places):
        # a simplex of a fifth of the range, into the range
        step = 0.2 * (high - low) * np.where(place > (low + high) / 2, -1, 1)
        simplex = np.vstack([place, place + np.diag(step)])
        try:
            minimize(
                wfe,
                place,
                args=(evaluations * (k + 1) // len(places),),
                method="Nelder-Mead",
                bounds=list(zip(low, high, strict=True)),
                options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-12, "adaptive": n > 4},
            )
        except _Enough:
            pass
    return Design(leading[1], leading[0], start_wfe, made)


class Cut(NamedTuple):
    """WFE along one variable, the others where they are: (n,) values and (n,) m rms."""

    variable: Variable
    values: Array
    wfe: Array


def cuts(
    system: System,
    variables: Sequence[Variable],
    values: Array,
    *,
    points: int = 7,
    reach: float = 0.5,
    threads: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Cut]:
    """How flat the optimum is: through ``values`` along each variable, ``reach`` of its range to either side."""
    found = []
    for n, variable in enumerate(variables):
        half = reach * (variable.high - variable.low) / 2
        line = np.linspace(max(variable.low, values[n] - half), min(variable.high, values[n] + half), points)
        errors = []
        for k, value in enumerate(line):
            progress((n + k / points) / len(variables))
            place = np.array(values, dtype=np.float64)
            place[n] = value
            errors.append(best_wfe(changed(system, variables, place), threads=threads))
        found.append(Cut(variable, line, np.array(errors)))
    return found


def misalignment(
    system: System,
    amounts: Sequence[float],
    *,
    draws: int = _DRAWS,
    seed: int = 1,
    threads: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> Array:
    """WFE when the sensors are not where the reconstructor takes them to be.

    Every sensor of more than one sub-aperture is off by the same amount, each in a random direction of its own; mirrors
    and stars stay. That the interaction matrix is another, too, is taken into account.

    Args:
        amounts: sub-apertures.
        draws: of directions; the mean of their variances is taken.
        threads: to compute with, apart from those of the BLAS library.

    Returns:
        (n_amounts,) m rms.
    """
    reconstructor, G = implicit(system, fast=True, threads=threads)
    R = reconstructor.R[0].astype(np.float64)
    nominal = Layout(system)
    angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, (draws, len(nominal.sensors)))
    errors = []
    for k, amount in enumerate(amounts):
        squares: list[float] = []
        for turn in angles[:1] if amount == 0 else angles:
            progress((k + len(squares) / draws) / len(amounts))
            layout = copy.copy(nominal)
            layout.sensors = tuple(
                replace(
                    place,
                    shift=(
                        place.shift[0] + amount * place.size * math.cos(angle),
                        place.shift[1] + amount * place.size * math.sin(angle),
                    ),
                )
                if place.n_valid > 1
                else place
                for place, angle in zip(nominal.sensors, turn, strict=True)
            )
            wrong = R @ (G - interaction_matrix(system, layout, threads))
            squares.append(wfe_of(R, system, layout, wrong, threads=threads) ** 2)
        errors.append(math.sqrt(float(np.mean(squares))))
    return np.array(errors)
