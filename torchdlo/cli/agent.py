"""Commands of `torchdlo` for agents that search or ask models; they import what is slow only when they run."""

from __future__ import annotations

import importlib.util
import itertools
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.progress import at_work, deferred_interrupt, progress
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.agents.vlm.carried import Result
    from torchdlo.agents.vlm.conversation import Conversation

__all__ = ["plan", "propose"]

_KEPT = {"exchanges": "[0-9][0-9][0-9]", "steps": "[0-9][0-9]"}
"""What a run keeps, by the folder, and how it is named there."""
_SEARCH = "[0-9][0-9]-[0-9a-f]{16}"
"""How searches of steps that are not over are named there."""

_Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for what is made.", metavar="DIR")]
_Endpoint = Annotated[
    str | None,
    typer.Option(help="Address of a server with OpenAI's protocol; without it nothing is sent.", metavar="URL"),
]
_Model = Annotated[str | None, typer.Option("--model", help="Name of the model there.", metavar="NAME")]
_Recorded = Annotated[
    Path | None,
    typer.Option("--recorded", help="Replay a conversation: a file, or the folder of a run.", metavar="PATH"),
]
_Geometry = Annotated[bool, typer.Option("--geometry", help="Decide by geometry, without a model; labelled as such.")]
_Calls = Annotated[int, typer.Option(min=1, help="Most requests.")]
_Tokens = Annotated[int, typer.Option(min=1, help="Most tokens of all requests and answers.")]
_Seconds = Annotated[float, typer.Option(min=0.1, help="Time for a request.")]
_Resume = Annotated[bool, typer.Option("--resume", help="Go on with a run that was stopped, and repeat nothing.")]


def _conversation(
    folder: Path,
    endpoint: str | None,
    model: str | None,
    recorded: Path | None,
    geometry: bool,
    *,
    calls: int,
    tokens: int,
    seconds: float,
    resume: bool,
) -> Conversation:
    """Return the conversation with the one that options name."""
    from torchdlo.errors import InputError

    if sum([endpoint is not None, recorded is not None, geometry]) != 1 or (endpoint is None) != (model is None):
        raise InputError("who is asked: expected one of --endpoint URL with --model NAME, --recorded PATH, --geometry.")
    if importlib.util.find_spec("pydantic") is None:
        raise InputError("models need the package pydantic; install it with pip install 'torchdlo[vlm]'.")
    from torchdlo.agents.vlm.conversation import Conversation, ConversationBudget
    from torchdlo.agents.vlm.endpoint import Endpoint
    from torchdlo.agents.vlm.geometry import Geometry
    from torchdlo.agents.vlm.recorded import load_recorded

    who: Any = Geometry()
    if recorded is not None:
        who = load_recorded(recorded)
    elif endpoint is not None and model is not None:
        who = Endpoint(endpoint, model, seconds=seconds)
    if not resume:
        clear(folder)
    said = Conversation(who, folder, ConversationBudget(calls, tokens), resume, lambda text: typer.echo(text, err=True))
    return said


def clear(folder: Path) -> None:
    """Delete what is kept of an earlier run."""
    from torchdlo.agents.trajopt.search_journal import remove_journal

    kept = [(folder / part).glob(f"{digits}.json") for part, digits in _KEPT.items()]
    for file in itertools.chain(*kept):
        check_writable(file)
        file.unlink()
    for file in (folder / "pictures").glob("*.png"):
        if re.fullmatch("[0-9a-f]{16}", file.stem):
            file.unlink()
    for search in (folder / "steps").glob("[0-9][0-9]-*"):
        if re.fullmatch(_SEARCH, search.name) and search.is_dir() and not search.is_symlink():
            remove_journal(search)


def propose(
    task: Annotated[str, typer.Argument(help="Name of the task.", metavar="TASK")],
    mode: Annotated[
        str, typer.Option(help="How grasps are said.", metavar="candidate|coefficient|marker")
    ] = "candidate",
    out: _Out = None,
    endpoint: _Endpoint = None,
    model: _Model = None,
    recorded: _Recorded = None,
    geometry: _Geometry = False,
    random: Annotated[
        int | None, typer.Option(min=0, help="Draw grasps by chance with this seed.", metavar="SEED")
    ] = None,
    calls: _Calls = 10,
    tokens: _Tokens = 200_000,
    seconds: _Seconds = 120.0,
    resume: _Resume = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the proposal as JSON.")] = False,
) -> None:
    """Propose what the hands are to hold at the start of a task.

    A model sees a picture and says where to hold the rope: by the number of a mark, by a share of its length, or
    by a place in the picture. What hands do not reach is refused with the reason and asked for again. Pictures and
    texts go to the endpoint that is given and nowhere else; its key is read from OPENAI_API_KEY. All that was said is
    kept.

    [bold]Examples:[/bold]

    torchdlo propose lifting --endpoint http://localhost:8000/v1 --model qwen-vl

    torchdlo propose unknotting --geometry --mode coefficient

    torchdlo optimize lifting --grasps runs/propose/lifting-candidate/proposal.json
    """
    from torchdlo.agents.vlm.grasp_proposal import places_of, random_grasps
    from torchdlo.agents.vlm.grasp_proposal import propose_grasps as ask
    from torchdlo.agents.vlm.plan_schema import MODES
    from torchdlo.envs import find, short_name
    from torchdlo.envs.core import episode
    from torchdlo.errors import InputError

    chosen = find(task)
    if mode not in MODES:
        raise InputError(f"mode: it is {mode!r}; expected one of {', '.join(MODES)}.")
    out = out or Path("runs") / "propose" / f"{short_name(task)}-{mode if random is None else f'random-{random}'}"
    check_writable(out / "proposal.json")
    if random is not None:
        found = random_grasps(places_of(chosen), random)
    else:
        limits: dict[str, Any] = {"calls": calls, "tokens": tokens, "seconds": seconds, "resume": resume}
        said = _conversation(out, endpoint, model, recorded, geometry, **limits)
        from torchdlo.report.render.episode_film import stills
        from torchdlo.report.render.marks import marked_view

        made = episode.prepare(chosen, 1, execution="eager")
        found = ask(chosen, mode, said, marked_view(stills(made, [made.start], arms=False)))
    write_atomically(out / "proposal.json", found.json())
    held = ", ".join(f"robot_{k + 1} {'open' if g is None else f'vertex {g}'}" for k, g in enumerate(found.grasps))
    typer.echo(f"{task}: {held} ({found.source})", err=as_json)
    typer.echo(f"proposal: {out / 'proposal.json'}", err=as_json)
    if as_json:
        typer.echo(json.dumps(json.loads(found.json()), indent=1))


def plan(
    task: Annotated[str, typer.Argument(help="Name of the task.", metavar="TASK")],
    out: _Out = None,
    endpoint: _Endpoint = None,
    model: _Model = None,
    recorded: _Recorded = None,
    geometry: _Geometry = False,
    update: Annotated[bool, typer.Option(help="Ask again after every step.")] = True,
    method: Annotated[str, typer.Option(help="How steps are searched.", metavar="hybrid|cmaes")] = "hybrid",
    episodes: Annotated[int, typer.Option(min=4, help="Budget of a step.")] = 240,
    population: Annotated[int, typer.Option(min=4, help="Trajectories per iteration.")] = 24,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the searches.")] = 0,
    reset_seed: Annotated[
        int | None,
        typer.Option(min=0, max=10**9, help="Seed of a start that differs from the usual one.", metavar="SEED"),
    ] = None,
    pictures: Annotated[bool, typer.Option(help="Draw pictures, and show them to the model.")] = True,
    calls: _Calls = 60,
    tokens: _Tokens = 2_000_000,
    seconds: _Seconds = 120.0,
    resume: _Resume = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what came of it as JSON.")] = False,
) -> None:
    """Split a task into steps with a model, search each, look at what came of it, and plan anew.

    The model says what hands hold in a step, what earns, and when the step is done, in a language that is interpreted
    and never run. After each step it sees stills and values and says what is left. The task's own condition decides
    whether it is done. Nothing is sent unless an endpoint is given. --no-update carries out the first plan as it is.

    [bold]Examples:[/bold]

    torchdlo plan wiring_ring --endpoint http://localhost:8000/v1 --model qwen-vl

    torchdlo plan wiring_ring --recorded runs/plan/wiring_ring --no-update --out runs/plan/again

    torchdlo plan lifting --geometry --episodes 480
    """
    from torchdlo.agents.vlm.decomposition import Options, carry_out
    from torchdlo.envs import find, short_name
    from torchdlo.errors import InputError
    from torchdlo.report.pages.plan import plan_html

    if method not in ("hybrid", "cmaes"):
        raise InputError(f"method: it is {method!r}; expected hybrid or cmaes.")
    chosen = find(task)
    out = out or Path("runs") / "plan" / short_name(task)
    for name in ("plan.json", "report.html"):
        check_writable(out / name)
    limits: dict[str, Any] = {"calls": calls, "tokens": tokens, "seconds": seconds, "resume": resume}
    look: Any = None
    if pictures:
        from torchdlo.report.render.marks import MarkCamera
        from torchdlo.report.render.picture import check_renderer

        check_renderer()
        look = MarkCamera()
    options = Options(
        update=update, method=method, episodes=episodes, population=population, seed=seed, reset_seed=reset_seed
    )
    with at_work(out, "plan.json", "report.html"):
        said = _conversation(out, endpoint, model, recorded, geometry, **limits)

        def write(found: Result) -> None:
            content = json.loads(found.json(options))
            shown = {p.stem: p.read_bytes() for p in (out / "pictures").glob("*.png")}
            exchanges = [*said.exchanges, *([said.unanswered] if said.unanswered else [])]
            write_atomically(out / "plan.json", found.json(options))
            write_atomically(out / "report.html", plan_html(content, exchanges, shown))

        try:
            with progress() as show, deferred_interrupt(show) as callback:
                found = carry_out(chosen, said, options, look=look, folder=out, callback=callback, unfinished=write)
        except KeyboardInterrupt:
            raise stopped(f"what is done is kept in {out}", resume=True) from None
        write(found)
    typer.echo(
        f"{task}: {found.ended} ({len(found.carried)} steps, {found.updates} updates, {found.source})", err=as_json
    )
    typer.echo(f"plan:   {out / 'plan.json'}\nreport: {out / 'report.html'}", err=as_json)
    if as_json:
        typer.echo(found.json(options), nl=False)
