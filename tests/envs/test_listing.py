"""The command that lists tasks."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from torchdlo.cli.app import app
from torchdlo.envs import TASKS

pytestmark = pytest.mark.quick


def test_tasks_are_listed_for_people_and_for_scripts():
    said = CliRunner().invoke(app, ["tasks"]).stdout
    assert "coiling      Coil a rope round a cone. (1 arm, 100 actions of 0.02 s)" in said
    rows = json.loads(CliRunner().invoke(app, ["tasks", "--json"]).stdout)
    assert [row["name"] for row in rows] == list(TASKS)
    assert {row["name"]: row["arms"] for row in rows}["wrapping"] == 2
