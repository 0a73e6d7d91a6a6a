"""What stands in the plant: tool types, tools and the regions of their edges."""

from __future__ import annotations

from django.db import models
from django.urls import reverse


class LifeUnit(models.TextChoices):
    """How a tool's use is counted (the units of MTConnect ToolLife and of sawmills)."""

    HOURS = "h", "hours"
    TONNES = "t", "tonnes"
    LOADS = "loads", "truck loads"
    CUTS = "cuts", "cuts"
    METRES = "m", "metres cut"
    PARTS = "parts", "parts"


class ToolType(models.Model):
    """A kind of tool: what its tools have in common, and where limits are set."""

    name = models.CharField(max_length=80, unique=True)
    bevel_angle_deg = models.FloatField(default=55.0)
    edge_length_mm = models.FloatField()
    life_unit = models.CharField(max_length=8, choices=LifeUnit, default=LifeUnit.HOURS)
    note = models.TextField(blank=True)

    class Meta:
        ordering = ["name"]

    def __str__(self) -> str:
        return self.name


class Tool(models.Model):
    """One tool with a number on it."""

    class Status(models.TextChoices):
        IN_SERVICE = "in service"
        SPARE = "spare"
        AT_GRINDING = "at grinding"
        RETIRED = "retired"

    code = models.CharField(max_length=40, unique=True, help_text="Engraved or on the label; what a scanner reads.")
    tool_type = models.ForeignKey(ToolType, on_delete=models.PROTECT, related_name="tools")
    location = models.CharField(max_length=80, blank=True, help_text="Machine and pocket.")
    status = models.CharField(max_length=12, choices=Status, default=Status.IN_SERVICE)
    life_used = models.FloatField(default=0.0, help_text="In the tool type's life unit, since the last regrind.")
    created_at = models.DateTimeField(auto_now_add=True)
    note = models.TextField(blank=True)

    class Meta:
        ordering = ["code"]

    def __str__(self) -> str:
        return self.code

    def get_absolute_url(self) -> str:
        return reverse("tool", args=[self.pk])


class Region(models.Model):
    """A stretch of a tool's edge that is scanned as one range image, with its flat part.

    ``start_mm`` and ``length_mm`` are stage positions along the edge. ``rows`` lie along the laser line, from
    ``row_offset`` on the sensor. The flat sub-region (rows ``flat_row`` .. ``flat_row + flat_rows``) is undamaged
    ground bevel: the precision report's sigma is taken there.
    """

    tool = models.ForeignKey(Tool, on_delete=models.CASCADE, related_name="regions")
    name = models.CharField(max_length=20)
    start_mm = models.FloatField()
    length_mm = models.FloatField()
    row_offset = models.PositiveIntegerField(default=0)
    rows = models.PositiveIntegerField(default=1000)
    flat_row = models.PositiveIntegerField(default=0)
    flat_rows = models.PositiveIntegerField(default=600)
    active = models.BooleanField(default=True)

    class Meta:
        ordering = ["tool_id", "name"]
        constraints = [models.UniqueConstraint(fields=["tool", "name"], name="region_name_unique_on_tool")]

    def __str__(self) -> str:
        return f"{self.tool.code} {self.name}"
