"""What a user may sweep in the fit of a sphere."""

from dataclasses import dataclass

from shinypartial.io.records import NonNegative


@dataclass(frozen=True)
class SphereOptions:
    """What is known of a ball and of who photographs it."""

    radius: NonNegative = 0.0
    """Known radius, in units of the world; 0: unknown. Views along one line leave open how large and how far away a
    ball is."""
    operator_deg: NonNegative = 12.0
    """Of several views, rays that return to their camera within this angle show who takes the pictures, and hardly
    count."""
