"""Demonstrations as data sets in LeRobot's format, v3.0: made, checked, merged, filtered and read.

Writing needs pyarrow and, with pictures, av; LeRobot itself is not needed.
"""

from torchdlo.agents.data.checking import check_dataset
from torchdlo.agents.data.editing import Choice, merge_datasets, select_episodes
from torchdlo.agents.data.making import DatasetPlan, make_dataset
from torchdlo.agents.data.reading import DataSet, FrameData, open_set, to_tensordict

__all__ = [
    "Choice",
    "DataSet",
    "DatasetPlan",
    "FrameData",
    "check_dataset",
    "make_dataset",
    "merge_datasets",
    "open_set",
    "select_episodes",
    "to_tensordict",
]
