"""Surface numbers: from a range image to wear, damage, edge and roughness, each with its uncertainty."""

from scanning.surface.damage import DamageFinding
from scanning.surface.inspection import inspect_surface
from scanning.surface.report import Measurement, SurfaceReport
from scanning.surface.settings import InspectionSettings, Severity

__all__ = ["DamageFinding", "InspectionSettings", "Measurement", "Severity", "SurfaceReport", "inspect_surface"]
