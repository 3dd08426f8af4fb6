"""What a demonstration was told to do: several ways to say the same, some of which no data set holds.

Those are kept for judging whether a policy understands more than the sentences that it has learned.
"""

from __future__ import annotations

import torch

from torchdlo.envs import find

__all__ = ["draw_instruction", "heldout_instructions", "training_instructions"]

_SAID: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "coiling": (
        (
            "Coil the rope round the cone.",
            "Wind the rope around the cone once.",
            "Wrap the rope about the cone.",
            "Lead the rope all the way round the cone.",
            "Take the rope's end and coil it around the cone.",
            "Make the rope go once round the cone.",
        ),
        ("Please loop the rope around the cone.", "The cone should have the rope coiled about it."),
    ),
    "coiling_left": (
        (
            "Coil the rope round the cone to the left.",
            "Wind the rope around the cone counterclockwise.",
            "Wrap the rope round the cone, going left.",
            "Lead the rope left about the cone.",
            "Go round the cone on the left with the rope, counterclockwise.",
            "Coil the rope counterclockwise about the cone.",
            "Go left round the cone with the rope.",
            "Wind the rope leftwards around the cone.",
            "Take the rope's end to the left and round the cone.",
            "Circle the cone leftwards with the rope.",
            "Bend the rope to the left about the cone.",
            "The rope should go left round the cone.",
        ),
        ("Please loop the rope leftwards around the cone.", "Turn left round the cone with the rope."),
    ),
    "coiling_right": (
        (
            "Coil the rope round the cone to the right.",
            "Wind the rope around the cone clockwise.",
            "Wrap the rope round the cone, going right.",
            "Lead the rope right about the cone.",
            "Go round the cone on the right with the rope, clockwise.",
            "Coil the rope clockwise about the cone.",
            "Go right round the cone with the rope.",
            "Wind the rope rightwards around the cone.",
            "Take the rope's end to the right and round the cone.",
            "Circle the cone rightwards with the rope.",
            "Bend the rope to the right about the cone.",
            "The rope should go right round the cone.",
        ),
        ("Please loop the rope rightwards around the cone.", "Turn right round the cone with the rope."),
    ),
    "gathering": (
        (
            "Gather the three objects with the rope.",
            "Bring the ball, the stone and the cylinder together with the rope.",
            "Use the rope to pull the objects into one heap.",
            "Sweep all objects together with the rope.",
        ),
        ("Collect the things on the table with the rope.",),
    ),
    "letter_art": (
        (
            "Write D and L beside the O with the wires.",
            "Bend the wires into the letters D and L.",
            "Form a D and an L next to the O.",
        ),
        ("Shape the wires so that they read D, L and O.",),
    ),
    "lifting": (
        (
            "Lift both rings with the rope.",
            "Hook the rope into the rings and lift them.",
            "Raise the two open rings with the rope.",
            "Pick the rings up with the rope.",
        ),
        ("Get the rings off the floor with the rope.",),
    ),
    "separation": (
        (
            "Take the two ropes apart.",
            "Separate the hooked ropes.",
            "Pull the two ropes away from each other.",
            "Untangle the ropes and lay them apart.",
            "Unhook one rope from the other.",
            "Move the ropes apart so that they do not cross.",
        ),
        ("Please disentangle both ropes.", "The two ropes should not touch any more."),
    ),
    "slingshot": (
        (
            "Shoot the ball at the cube.",
            "Pull the band back and shoot the ball.",
            "Hit the cube with the ball from the slingshot.",
            "Fire the ball with the slingshot so that it hits the cube.",
            "Draw the slingshot and knock the cube away.",
            "Use the slingshot to push the cube with the ball.",
        ),
        ("Please sling the ball against the cube.", "Stretch the band and let the ball fly at the box."),
    ),
    "unknotting": (
        ("Untie the knot.", "Open the knot in the rope.", "Undo the overhand knot.", "Straighten the rope out."),
        ("Get the knot out of the rope.",),
    ),
    "wiring_post": (
        (
            "Lead the rope in an S round the two posts.",
            "Route the cable around both posts in an S shape.",
            "Lay the rope round the posts like the letter S.",
            "Wind the rope past the first post and then round the second.",
            "Thread the rope in an S between the posts.",
            "Bend the rope round both posts, one on each side.",
        ),
        ("Please run the wire about the two posts so that it makes an S.", "Make an S with the rope about the posts."),
    ),
    "wiring_ring": (
        (
            "Lead the rope through both rings.",
            "Thread the rope through the two rings.",
            "Pull the wire through the rings.",
        ),
        ("Pass the rope's end through one ring and then the other.",),
    ),
    "wrapping": (
        (
            "Put the band round the three posts.",
            "Wrap the rubber band around all posts.",
            "Stretch the band over the three posts.",
            "Lay the loop about the posts.",
        ),
        ("All three posts should be inside the band.",),
    ),
}
"""By task: what data sets say, and what they do not."""


def training_instructions(task: str) -> tuple[str, ...]:
    """Return the sentences that data sets of a task hold."""
    return _SAID[task][0] if task in _SAID else (_plain(task),)


def heldout_instructions(task: str) -> tuple[str, ...]:
    """Return sentences that mean the same and that no data set holds."""
    return _SAID[task][1] if task in _SAID else (_plain(task),)


def draw_instruction(task: str, seed: int, plain: str = "") -> str:
    """Return one of the sentences of a task, drawn from a seed; `plain` is what a task of one's own says of itself."""
    said = training_instructions(task) if task in _SAID or not plain else (plain,)
    return said[int(torch.randint(len(said), (), generator=torch.Generator().manual_seed(seed)))]


def _plain(task: str) -> str:
    return (type(find(task)).__doc__ or task).splitlines()[0]
