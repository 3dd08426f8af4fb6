"""Over how much of the films models are compared, and whether the rope is a chain of links there.

Where something large is missing, a baseline can follow the beginnings of films only; what takes up an effect follows
them longer. Simulated ropes may be chains of stiff links: what that explains is no merit of an effect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchdlo.sysid.diagnosis.error_floor import gap_rms
from torchdlo.sysid.diagnosis.workspace import CHAIN
from torchdlo.sysid.model.rope_model import MAX_SUBSTEP
from torchdlo.sysid.video.filmed import corrected, require_simulated, sharper
from torchdlo.sysid.video.filmed_fit import Fit, film_gaps, fit, gate
from torchdlo.sysid.video.filmed_model import FilmedModel, Films, extended
from torchdlo.sysid.video.filmed_problem import FilmedProblem, correct
from torchdlo.sysid.video.filmed_scores import LeftOver
from torchdlo.sysid.video.filmed_starts import restart
from torchdlo.sysid.video.fit_pool import FitPool

__all__ = ["NEAR", "alike", "chain_note", "chained", "further", "left_out", "nearer"]

Callback = Callable[[str, int, int, str], None]

NEAR = 5e-3
"""Gap [m] from which a baseline is not near its films: only the beginnings of trials are then looked at."""

_SHARES = (0.6, 0.35, 0.2)
"""Shares of the time that are tried for these."""

_LONGER = 1.5
"""Times as much of the films that a model with a new effect is fitted to at once."""

_FOLLOW = 6
"""Most steps of each such fit."""

_ROUGH = 1e-2
"""Share of the cost that another step has to save of fits that show which way links lie."""

_BETTER, _TELLS = 0.9, 0.05
"""Share of the cost that is left where the rope is taken for a chain, and that of what a model leaves over that links
have to explain, to first order, to be fitted: of a fall of the cost by a tenth they explain a fifth."""


def nearer(films: Films, best: Fit, report: Callback) -> FilmedModel:
    """Return the baseline of as much of the films' beginnings as it can stay near to.

    Over longer times the answer to what is missing is so large that nothing leads back to it: other numbers have gone
    far off to follow at all, and small doses of the right effect do not help them.
    """
    whole, raw = films.whole, best.raw
    coarse = whole.with_options(substep=MAX_SUBSTEP)
    for share in _SHARES:
        own = coarse.over(whole, share * whole.lasts)
        found = _followed(own, raw)
        coarse.offset = own.offset
        report("fitting the beginnings", 1, 1, f"{own.lasts:.2f} s: {1e3 * gap_rms(film_gaps(own, found)):.2f} mm")
        if film_gaps(own, found).max() < NEAR:
            break
        raw = found.raw
    require_simulated(whole.model.recording, found)
    # Finer simulations may need other starts.
    found = restart(own, sharper(own, found.raw, _FOLLOW), _FOLLOW)
    return films.test(own, found)


def _followed(own: FilmedProblem, raw: np.ndarray) -> Fit:
    """Return a fit without wrong frames: one of them, that nothing explains, is no reason to go no further."""
    found = restart(own, fit(own, raw, _FOLLOW), _FOLLOW)
    if np.isfinite(found.cost) and gate(own, own.space.to_values(found.raw)):
        found = fit(own, found.raw, _FOLLOW)
    return found


def further(
    films: Films, first: FilmedModel, found: FilmedModel, chains: bool, report: Callback, pool: FitPool
) -> tuple[FilmedModel, FilmedModel]:
    """Return the baseline and the model that took up an effect, over as much of the films as that stays near to.

    What the lack of the effect hid is looked for, too, unless `chains` is false: whether the rope is a chain of links.
    The baseline then becomes one as well: what links explain is no merit of the effect.
    """
    whole, begun_with = films.whole, found.own.lasts
    chain = not chains or CHAIN in found.own.model.effects
    if not chain:
        found = chained(found, pool)
        chain = CHAIN in found.own.model.effects
    while found.own.lasts < whole.lasts:
        own = found.own.over(whole, min(_LONGER * found.own.lasts, whole.lasts))
        best = _followed(own, found.fit.raw)
        report("fitting longer", 1, 1, f"{own.lasts:.2f} s: {1e3 * gap_rms(film_gaps(own, best)):.2f} mm")
        if not chain:
            other = chained(FilmedModel(own, best, own), pool)  # only its train trials matter here
            chain = CHAIN in other.own.model.effects
            own, best = other.own, other.fit
        if not film_gaps(own, best).max() < NEAR:
            break
        found = replace(found, own=own, fit=best)
    if found.own.lasts == begun_with:
        # What a fit that has not come to its end leaves over looks like another effect.
        found = films.test(found.own, corrected(found.own, found.fit.raw, _FOLLOW))
        report("fitting to its end", 1, 1, f"{1e3 * gap_rms(found.gaps('train')):.2f} mm")
        return alike(first, found), found
    # Both are compared to films with what finer simulations change.
    found = films.test(found.own, corrected(found.own, found.fit.raw, _FOLLOW))
    plain = first.own.over(whole, found.own.lasts)
    return alike(films.test(plain, corrected(plain, first.fit.raw, _FOLLOW)), found), found


def alike(first: FilmedModel, found: FilmedModel) -> FilmedModel:
    """Return the baseline as a chain of links if the model is one, unless films fit worse to that."""
    length = links_of(found)
    if length is None or links_of(first) is not None:
        return first
    chain = linked(first, length)
    chain = replace(chain, fit=fit(chain.own, chain.fit.raw, _FOLLOW))
    return chain if chain.fit.cost < first.fit.cost else first


def links_of(model: FilmedModel) -> float | None:
    """Return the length of a chain's links [m], with the sign of their number; None of a rope."""
    own = model.own
    if CHAIN not in own.model.effects:
        return None
    return float(own.full(model.values[None])[0, own.model.parameters.index(f"{CHAIN}.length")])


def chain_note(final: FilmedModel) -> list[str]:
    """Return that the rope was taken for a chain of links."""
    length = links_of(final)
    if length is None:
        return []
    return [
        f"The rope moves like a chain of links of about {1e3 * abs(length):.0f} mm, as simulated ones may; what that "
        "explains is not counted as an effect."
    ]


def left_out(final: FilmedModel, whole: FilmedProblem) -> list[str]:
    """Return that films were not compared to their ends."""
    if not final.own.lasts < whole.lasts:
        return []
    begun = f"Only the first {final.own.lasts:.2f} s of each trial count"
    if not final.gaps("train").max() < NEAR:
        return [f"{begun}, and even over these no model stayed within {1e3 * NEAR:.0f} mm of the films."]
    return [f"{begun}: over longer times no model stayed within {1e3 * NEAR:.0f} mm of the films."]


def chained(plain: FilmedModel, pool: FitPool) -> FilmedModel:
    """Return the model as a chain of links, if films fit to that much better."""
    link = float(np.diff(plain.own.model.arclength).min())
    lengths = [length for length in (link, -link) if _links_tell(plain, length)]
    if not lengths:
        return plain
    sides = pool.all(_as_chain, [(plain, length) for length in lengths])
    best = min(sides, key=lambda s: s.fit.cost)
    if not best.fit.cost < plain.fit.cost:
        return plain
    best = replace(best, fit=fit(best.own, best.fit.raw, 6))
    return best if best.fit.cost < _BETTER * plain.fit.cost else plain


def _links_tell(plain: FilmedModel, length: float) -> bool:
    """Return whether links of this length [m] change what the model leaves over, beyond what its numbers can."""
    own, chain = plain.own, linked(plain, length)
    sims = np.concatenate([own.simulate(plain.values[None]), chain.own.simulate(chain.values[None])])
    cameras = np.repeat(plain.values[None, len(own.free) :], 2, 0)
    read = own.spines.changes(sims, cameras)[..., 0]
    return not LeftOver(own, plain.fit).explained(read[1] - read[0]) < _TELLS


def _as_chain(plain: FilmedModel, length: float) -> FilmedModel:
    chain = linked(plain, length)
    return replace(chain, fit=fit(chain.own, chain.fit.raw, 2, tolerance=_ROUGH))


def linked(plain: FilmedModel, length: float) -> FilmedModel:
    """Return the model as a chain of links of this length [m], not yet fitted."""
    link = float(np.diff(plain.own.model.arclength).min())
    chain = extended(plain, (CHAIN,), {f"{CHAIN}.length": 0.5 * link}, {f"{CHAIN}.length": length}, None)
    for problem in (chain.own, chain.test):
        if (known := problem.discretisation_correction) is not None:
            # A mesh with edges as long as the links is not wrong.
            correct(problem, replace(known, links=abs(length)))
    return chain
