"""The same work in processes of this machine or, through Ray, on several."""

from torchdlo.agents.distributed.executors import Executor, LocalProcesses, Serial, make_executor

__all__ = ["Executor", "LocalProcesses", "Serial", "make_executor"]
