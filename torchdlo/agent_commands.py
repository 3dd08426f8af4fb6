"""Commands of `torchdlo` for agents on vision-language models; they import what is slow only when they run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    from torchdlo.agents.vlm.conversation import Conversation

__all__ = ["propose"]

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
_Resume = Annotated[bool, typer.Option("--resume", help="Go on with a run that was stopped, without asking anew.")]


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
    try:
        import pydantic  # noqa: F401
    except ImportError:
        raise InputError("models need the package pydantic; install it with pip install 'torchdlo[vlm]'.") from None
    from torchdlo.agents.vlm.conversation import Budget, Conversation
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
    said = Conversation(who, folder, Budget(calls, tokens), resume, lambda text: typer.echo(text, err=True))
    return said


def clear(folder: Path) -> None:
    """Delete exchanges of an earlier run."""
    for file in [*(folder / "exchanges").glob("[0-9][0-9][0-9].json"), *(folder / "pictures").glob("*.png")]:
        check_writable(file, mark=b"torchdlo" if file.suffix == ".json" else b"PNG")
        file.unlink()


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

    A model sees a picture and says where to hold the rope: by the number of a mark, by a share of the rope's length, or
    by a place in the picture. What hands do not reach is refused with the reason and asked for again. Pictures and
    texts go to the endpoint that is given and nowhere else; its key is read from OPENAI_API_KEY. All that was said is
    kept.

    [bold]Examples:[/bold]

    torchdlo propose lifting --endpoint http://localhost:8000/v1 --model qwen-vl

    torchdlo propose unknotting --geometry --mode coefficient

    torchdlo optimize lifting --grasps runs/propose/lifting-candidate/proposal.json
    """
    from torchdlo.agents.vlm.grasp_proposal import places_of, random_grasps
    from torchdlo.agents.vlm.grasp_proposal import propose as ask
    from torchdlo.agents.vlm.schema import MODES
    from torchdlo.envs import find
    from torchdlo.envs.core import episode
    from torchdlo.errors import InputError

    chosen = find(task)
    if mode not in MODES:
        raise InputError(f"mode: it is {mode!r}; expected one of {', '.join(MODES)}.")
    out = out or Path("runs") / "propose" / f"{task}-{mode if random is None else f'random-{random}'}"
    check_writable(out / "proposal.json")
    if random is not None:
        found = random_grasps(places_of(chosen), random)
    else:
        limits = {"calls": calls, "tokens": tokens, "seconds": seconds, "resume": resume}
        said = _conversation(out, endpoint, model, recorded, geometry, **limits)
        from torchdlo.report.marks import marked_view
        from torchdlo.report.render.episode_film import stills

        made = episode.prepare(chosen, 1, compiled=False)
        found = ask(chosen, mode, said, marked_view(stills(made, [made.start], arms=False)))
    write_atomically(out / "proposal.json", found.json())
    held = ", ".join(f"robot_{k + 1} {'open' if g is None else f'vertex {g}'}" for k, g in enumerate(found.grasps))
    typer.echo(f"{task}: {held} ({found.source})", err=as_json)
    typer.echo(f"proposal: {out / 'proposal.json'}", err=as_json)
    if as_json:
        typer.echo(json.dumps(json.loads(found.json()), indent=1))
