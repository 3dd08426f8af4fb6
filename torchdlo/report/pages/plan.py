"""The page about a plan that was carried out: pictures, steps, rewards, what was said, and what it cost."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

from torchdlo.report.pages.page import STYLE, number, page, table
from torchdlo.untrusted import for_html

__all__ = ["plan_html"]

_STYLE = STYLE + ".said { white-space: pre-wrap; } .bad { color: var(--before); } .good { color: var(--after); }\n"
_SENT = "All texts and pictures below were sent to the one that is named above, and to nobody else."
_NOT_SENT = "Nothing was sent to anybody: this is what a model would have been told and shown."
_SHOWN = 20_000
"""Most letters of a text that are shown."""


def plan_html(result: Mapping[str, Any], exchanges: Sequence[Mapping[str, Any]], pictures: Mapping[str, bytes]) -> str:
    """Return the page.

    Args:
        result: content of plan.json.
        exchanges: all that was said, as it is kept.
        pictures: pictures as PNG by the first 16 letters of their hashes.
    """
    done = result["success"]
    verdict = "The task is done." if done else f"The task is not done: {result['ended']}."
    parts = [
        f"<h1>{for_html(result['task'])}</h1>",
        f'<p class="verdict {"good" if done else "bad"}">{for_html(verdict)}</p>',
        f"<p>Planned by: <b>{for_html(result['source'])}</b>. The task's own condition decided whether it is done. "
        f"The plan was {'' if result['options']['update'] else 'not '}updated after every step.</p>",
        table(("steps", "updates", "requests", "tokens", "episodes", "seconds"), [_cost(result)]),
    ]
    for place, carried in enumerate(result["steps"], 1):
        parts += _step(place, carried, pictures)
    parts.append("<h2>What was said</h2>")
    parts.append(f"<p>{_SENT if result['source'].startswith('model ') else _NOT_SENT}</p>")
    for each in exchanges:
        parts += _exchange(each, pictures)
    return page(f"torchdlo plan: {result['task']}", _STYLE, "\n".join(parts))


def _cost(result: Mapping[str, Any]) -> tuple[str, ...]:
    names = ("updates", "calls", "tokens", "episodes")
    return (str(len(result["steps"])), *(str(result[n]) for n in names), number(result["seconds"]))


def _step(place: int, carried: Mapping[str, Any], pictures: Mapping[str, bytes]) -> list[str]:
    step = carried["step"]
    how = "failed and was taken back" if carried["failed"] else "done" if carried["success"] else "not done"
    held = ", ".join(f"{name} {'open' if v is None else f'vertex {v}'}" for name, v in step["grasps"].items())
    rows = [(name, text, number(carried["terms"].get(name))) for name, text in step["reward"].items()]
    rows.append(("success", step["success"], "yes" if carried["success"] else "no"))
    found = [
        f"<h2>{place}. {for_html(step['description'])}</h2>",
        f'<p class="{"good" if carried["success"] else "bad"}">{how}</p>',
        f"<p>{for_html(held)}; {step['horizon']} actions; {_counted(carried['episodes'])} in "
        f"{number(carried['seconds'])} s. {for_html(step['reward_description'])}</p>",
        f'<div class="text">{table(("term", "expression", "at the end"), rows)}</div>',
    ]
    if carried["failed"]:
        found.append(f"<p>{for_html(carried['failed'])}</p>")
    return [*found, *(_image(pictures, digest) for digest in carried["pictures"])]


def _counted(episodes: int) -> str:
    return "1 episode" if episodes == 1 else f"{episodes} episodes"


def _image(pictures: Mapping[str, bytes], digest: str) -> str:
    content = pictures.get(digest)
    if content is None:
        return f'<p class="soft">picture {for_html(digest)}</p>'
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(content).decode()}">'


def _exchange(each: Mapping[str, Any], pictures: Mapping[str, bytes]) -> list[str]:
    request = each["request"]
    head = f"{each['number']}. {request['kind']}: {each['tokens']} tokens, {number(each['seconds'])} s"
    found = [f"<details><summary>{for_html(head)}</summary>"]
    for message in request["messages"]:
        found.append(f"<h3>{for_html(message['role'])}</h3>")
        found.append(f'<pre class="said">{for_html(message["text"][:_SHOWN])}</pre>')
        found += [_image(pictures, digest[:16]) for digest in message["pictures"]]
    found += [
        f"<h3>{for_html(each['source'])}</h3>",
        f'<pre class="said">{for_html(_pretty(each))}</pre></details>',
    ]
    return found


def _pretty(each: Mapping[str, Any]) -> str:
    if each["response"] is None:
        return "(no answer came)"
    text = each["response"][:_SHOWN]
    try:
        return json.dumps(json.loads(text), indent=1)
    except (ValueError, RecursionError):
        return text
