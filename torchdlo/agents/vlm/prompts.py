"""The texts that models are sent; they are files beside this one."""

from __future__ import annotations

from importlib.resources import files

__all__ = ["fill_prompt"]


def fill_prompt(name: str, **parts: str) -> str:
    """Return a text with its parts filled in."""
    text = (files("torchdlo.agents.vlm") / "prompts" / f"{name}.md").read_text(encoding="utf-8")
    for key, part in parts.items():
        # Nothing in a part may end the data; comparisons may stay.
        text = text.replace("{" + key + "}", part.replace("</", "< /").replace("<data", "< data"))
    return text
