"""Layouts by the names that the command takes."""

from shinypartial.conversion.captures.base import Reader
from shinypartial.conversion.captures.objects_with_lighting import read_objects_with_lighting
from shinypartial.conversion.captures.stanford_orb import read_stanford_orb
from shinypartial.conversion.layouts import CaptureLayout

READERS: dict[CaptureLayout, Reader] = {
    "stanford-orb": read_stanford_orb,
    "objects-with-lighting": read_objects_with_lighting,
}
