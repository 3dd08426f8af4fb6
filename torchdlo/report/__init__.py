"""Pictures and pages made of results."""

from __future__ import annotations

from torchdlo.report.pages.calibration import write_report

__all__ = ["write_report"]
