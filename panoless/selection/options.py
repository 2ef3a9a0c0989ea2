"""What of cameras and photographs may be wrong, and is corrected where the scene needs it."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class CorrectionOptions:
    """Corrections: `auto` where the scene needs them, `off` never, `on` always."""

    poses: Literal["auto", "off", "on"] = "auto"
    """Whether cameras may be elsewhere than stated."""
    masks: Literal["auto", "off"] = "auto"
    """Whether masks may be too small or too large, all by one distance and each by another."""
    repair: Literal["auto", "off"] = "auto"
    """Whether parts are added to masks, or taken from them, that the other views contradict."""
    exposure: Literal["auto", "off"] = "auto"
    """Whether views, or their channels, may be exposed differently; never in a high dynamic range."""
    lens: Literal["auto", "on", "off"] = "auto"
    """Whether the focal length of all views may be wrong by one factor, and their lens distort."""
