"""What models have to answer, as pydantic models that forbid everything else."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

__all__ = ["HORIZON", "MODES", "STEPS", "Step", "TaskPlan", "Update", "grasps_model", "step_models"]

STEPS, HORIZON = 8, 140
"""Most steps of a plan, and most actions of a step."""
MODES = ("candidate", "coefficient", "marker")
"""How grasps are said: by the number of a mark, as a share of a rope's length, or by a place in the picture."""

Text = Annotated[str, Field(max_length=2000)]
Expression = Annotated[str, Field(min_length=1, max_length=4000)]
Coordinate = Annotated[float, Field(ge=-10, le=10)]


class Strict(BaseModel):
    """Forbids what is not asked for, and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Coefficient(Strict):
    """A place on a rope, as a share of its length."""

    rope: int = Field(default=0, ge=0, le=100)
    share: float = Field(ge=0, le=1)


class Marker(Strict):
    """A place in the picture, in pixels from its upper left corner."""

    u: float = Field(ge=0, le=100_000)
    v: float = Field(ge=0, le=100_000)


def _robots(count: int, kind: Any) -> dict[str, Any]:
    return {f"robot_{k + 1}": (kind | None, ...) for k in range(count)}


def grasps_model(mode: str, hands: int) -> type[BaseModel]:
    """Return what an answer with grasps has to fit."""
    place: Any = {"candidate": Annotated[int, Field(ge=0, le=100_000)], "coefficient": Coefficient, "marker": Marker}[
        mode
    ]
    robots = create_model("Robots", __base__=Strict, **_robots(hands, place))
    return create_model("Grasps", __base__=Strict, reason=(Text, ""), grasps=(robots, ...))


class Step(Strict):
    """A step of a plan; `step_models` adds hands."""

    id: int = Field(ge=0, le=1000)
    description: Text
    reward: dict[str, Expression] = Field(min_length=1, max_length=12)
    reward_description: Text = ""
    success: Expression
    horizon: int = Field(ge=1, le=HORIZON)


class TaskPlan(Strict):
    """A plan; `step_models` says of what."""

    steps: list[Any] = Field(min_length=1, max_length=STEPS)
    completion: Text = ""


class Update(Strict):
    """Whether all is done, or what is left to do."""

    complete: bool = False
    reason: Text = ""
    steps: list[Any] = Field(default=[], max_length=STEPS)
    completion: Text = ""


def step_models(hands: int) -> tuple[type[TaskPlan], type[Update]]:
    """Return what plans and updates have to fit, for so many hands."""
    robots = create_model("Robots", __base__=Strict, **_robots(hands, Annotated[int, Field(ge=0, le=100_000)]))
    way = Annotated[list[Annotated[list[Coordinate], Field(min_length=3, max_length=3)]], Field(max_length=20)]
    ways: dict[str, Any] = {f"robot_{k + 1}": (way | None, None) for k in range(hands)}
    stage_waypoints = create_model("Waypoints", __base__=Strict, **ways)
    parts: dict[str, Any] = {"grasps": (robots, ...), "waypoints": (stage_waypoints | None, None)}
    step = create_model("Step", __base__=Step, **parts)

    def listed(cls: Any, content: Any) -> Any:
        # The published form is the bare list of steps.
        return {"steps": content} if isinstance(content, list) else content

    # Pydantic takes class methods, as its documentation has them; its types do not say so.
    before = model_validator(mode="before")(classmethod(listed))  # type: ignore[arg-type]
    validators: dict[str, Any] = {"listed": before}
    steps = Annotated[list[step], Field(min_length=1, max_length=STEPS)]  # type: ignore[valid-type]
    plan = create_model("Plan", __base__=TaskPlan, __validators__=validators, steps=(steps, ...))
    rest = Annotated[list[step], Field(max_length=STEPS)]  # type: ignore[valid-type]
    update = create_model("Update", __base__=Update, __validators__=validators, steps=(rest, []))
    return plan, update
