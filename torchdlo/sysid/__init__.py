"""System identification: measured recordings, what to beat, and calibration of a rope to them."""

from __future__ import annotations

from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording, save_recording, save_trial

__all__ = ["Recording", "Trial", "load_recording", "save_recording", "save_trial"]
