"""Models that a recording cannot tell apart: which they are, and each of them fitted to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import baseline as baselines
from torchdlo.sysid.diagnosis import budget as plan
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.score_test import Score, score_effects
from torchdlo.sysid.diagnosis.workspace import Callback, Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted
from torchdlo.sysid.estimation.result_cache import digest
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import one_line, read_entry

__all__ = ["check_names", "diagnosed", "fit_rivals"]


def diagnosed(folder: Path, recording: Recording) -> tuple[list[list[str]], ModelFile]:
    """Return sets of effects that a finished diagnosis could not tell apart, and its model.

    Args:
        folder: what `torchdlo diagnose` wrote.
        recording: without what cannot be trusted, see `data_quality.check`.

    Raises:
        InputError: The folder is not one of a diagnosis, or one of another recording.
    """
    file = folder / "findings.json"
    found = read_entry(file, "the findings of torchdlo diagnose", cure="run it first, or give --effects")
    if found.object().get("generator") != "torchdlo diagnose":
        raise InputError(f"{file}: expected the findings of torchdlo diagnose, found something else.")
    if found.object().get("recording_sha256") not in _digests(recording):
        other = one_line(found.object().get("recording"), 80)
        raise InputError(
            f"{file}: expected the diagnosis of {recording.path}, found that of another recording ({other}), or of an "
            "earlier content of it; run torchdlo diagnose again."
        )
    ties = [
        [e["name"].text(), *(name.text() for name in e["indistinguishable_from"].items())]
        for e in found["effects"].items()
    ]
    return ties, model_file.load(folder / "model.json")


def _digests(recording: Recording) -> set[str]:
    """Return the hashes of what a diagnosis may have used of a recording: all of it, or some of its train trials."""
    parts = (plan.pick_trials(recording, k + 1) for k in range(len(recording.train)))
    return {digest({f.name: getattr(p, f.name) for f in dataclasses.fields(p)[1:]}) for p in parts}


def check_names(names: Sequence[str], ties: list[list[str]] | None, bench: Workspace) -> tuple[str, ...]:
    """Return the effects to tell apart: those asked for, or the first ones that tie.

    Raises:
        InputError: One is not known or cannot act here, or there are fewer than two.
    """
    recording, mesh = bench.recording, bench.pool.local.model(()).mesh
    for name in names:
        effect_library.check_known("names", name)
        if not effect_library.applicable(name, recording, mesh):
            raise InputError(
                f"names: {name} cannot act in {recording.path} (no table, or no clamp of two markers); leave it out."
            )
    if not names:
        names = next((tie for tie in ties or [] if len(tie) > 1), ())
        if not names:
            found = ", ".join(tie[0] for tie in ties or []) or "no effect"
            raise InputError(
                f"{recording.path}: there is nothing to separate: the diagnosis names {found}, and nothing ties with "
                "it; give --effects with two effects to tell apart."
            )
    if len(set(names)) < 2:
        raise InputError(f"names: expected two or more effects to tell apart, found {', '.join(names)}.")
    return tuple(dict.fromkeys(names))


def fit_rivals(
    bench: Workspace, names: Sequence[str], given: ModelFile | None, seed: int, report: Callback
) -> tuple[Workspace, dict[str, Fitted]]:
    """Return the model of each name, fitted to the train trials, and the workspace for them.

    Args:
        bench: the trials.
        names: effects, one for each model, on top of one baseline.
        given: model of a diagnosis, from which the baseline and the numbers of its own effects are taken.
        seed: of the random starts of a baseline that is not given.
        report: told how it goes.
    """
    budget = plan.BUDGETS["fast"]
    if given is None:
        bench, base = baselines.calibrate_baseline(
            bench, budget.starts, budget.more, np.random.default_rng(seed), report
        )
    else:
        bench, base = baselines.go_on(bench, _without(given, names), budget.more, report)
    start = bench.starts["train"]
    stage = "fitting the rivals"
    scores = score_effects(bench.pool, base, names, start, lambda k, n: report(f"{stage}: doses", k, n, ""))
    jobs = {s.name: _job(bench, base, s, budget.iterations) for s in scores}
    if given is not None:
        model = given.model(bench.recording, **bench.pool.local.options)
        sizes = given.sizes(model)
        own = FitJob(
            given.effects, given.start(model)[None], tuple(sizes), tuple(sizes.values()), budget.iterations, start
        )
        jobs |= {n: own for n in names if n in given.effects and not set(given.effects) & ({*names} - {n})}
    found: dict[str, Fitted] = {}
    for more in (0, budget.more):
        again = [jobs[n] if not more else bench.further(found[n], more) for n in names]
        report(stage, 1 if more else 0, 2, "")
        found = dict(zip(names, bench.fit(again), strict=True))
    report(stage, 2, 2, ", ".join(f"{n.replace('_', ' ')} {1e3 * found[n].point.cost:.2f} mm" for n in names))
    return bench, found


def _without(given: ModelFile, names: Sequence[str]) -> ModelFile:
    """Return a model without some of its effects."""
    values = {k: v for k, v in given.values.items() if ParameterName.parse(k).effect not in names}
    return replace(given, effects=tuple(e for e in given.effects if e not in names), values=values)


def _job(bench: Workspace, base: Fitted, score: Score, iterations: int) -> FitJob:
    """Return the job of fitting the baseline with one effect more, from the doses that suit best."""
    # All that any dose uses: a wind may turn from where the best dose blows.
    used = [n.name for n in effect_library.numbers(score.name, bench.recording) if n.name in score.sizes]
    return bench.extension(base, score, used, iterations, None)
