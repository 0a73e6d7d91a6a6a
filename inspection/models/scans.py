"""Visits of tools to rigs. The Scan table is the queue: there is no other list of what is to be done."""

from __future__ import annotations

from django.conf import settings
from django.db import models
from django.db.models import Q
from django.urls import reverse

from inspection.models.plant import Region, Tool
from inspection.models.rigs import Calibration, LimitSet, Recipe, Rig
from inspection.states import ENDED, LIVE, ON_RIG, ScanState


class Inspection(models.Model):
    """One visit of a tool to a rig: one scan per region."""

    tool = models.ForeignKey(Tool, on_delete=models.PROTECT, related_name="inspections")
    requested_by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    requested_at = models.DateTimeField()
    reason = models.CharField(max_length=200, blank=True)
    life_used = models.FloatField(null=True, blank=True, help_text="The tool's use when it was scanned.")

    class Meta:
        ordering = ["-requested_at", "-pk"]
        indexes = [models.Index(fields=["tool", "-requested_at"])]  # a tool's history, newest first

    def __str__(self) -> str:
        return f"{self.tool.code} {self.requested_at:%Y-%m-%d %H:%M}"

    def get_absolute_url(self) -> str:
        return reverse("inspection", args=[self.pk])


class Scan(models.Model):
    """One region of one tool, scanned once.

    ``plan`` is the order as it was given (start, steps, exposures, sensor rows, flat part), frozen when queued, so that
    editing a region later does not change what an old scan means. The lease columns belong to the worker that drives
    the rig; the request columns to people; neither writes the other's.
    ``position`` orders the queue of a rig; ties go to the lower id.
    """

    class Source(models.TextChoices):
        RIG = "rig"
        IMPORT = "import"

    inspection = models.ForeignKey(Inspection, on_delete=models.PROTECT, related_name="scans")
    region = models.ForeignKey(Region, on_delete=models.PROTECT, related_name="scans")
    rig = models.ForeignKey(Rig, on_delete=models.PROTECT, related_name="scans")
    source = models.CharField(max_length=6, choices=Source, default=Source.RIG)
    state = models.CharField(max_length=12, choices=ScanState, default=ScanState.QUEUED)
    position = models.FloatField(default=0.0)
    requested_by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    queued_at = models.DateTimeField()
    started_at = models.DateTimeField(null=True, blank=True)
    finished_at = models.DateTimeField(null=True, blank=True)

    plan = models.JSONField(default=dict)
    recipe = models.ForeignKey(Recipe, on_delete=models.PROTECT, related_name="scans")
    calibration = models.ForeignKey(Calibration, null=True, blank=True, on_delete=models.PROTECT, related_name="scans")
    limit_set = models.ForeignKey(LimitSet, null=True, blank=True, on_delete=models.PROTECT, related_name="scans")

    lease_token = models.UUIDField(null=True, blank=True)
    lease_until = models.DateTimeField(null=True, blank=True)
    attempts = models.PositiveIntegerField(default=0)
    worker = models.CharField(max_length=120, blank=True)

    phase = models.CharField(max_length=20, blank=True)
    done = models.PositiveIntegerField(default=0)
    total = models.PositiveIntegerField(default=0)
    message = models.CharField(max_length=300, blank=True)
    progress_at = models.DateTimeField(null=True, blank=True)

    cancel_requested_at = models.DateTimeField(null=True, blank=True)
    cancel_requested_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, blank=True, on_delete=models.SET_NULL, related_name="+"
    )
    pause_requested_at = models.DateTimeField(null=True, blank=True)
    finish_requested_at = models.DateTimeField(null=True, blank=True)
    stop_requested_at = models.DateTimeField(null=True, blank=True, help_text="Emergency stop: looked at 40 times a s.")
    stop_requested_by = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, blank=True, on_delete=models.SET_NULL, related_name="+"
    )
    continued = models.PositiveIntegerField(default=0, help_text="How often it went on after it had been interrupted.")

    fault = models.CharField(max_length=500, blank=True, help_text="One sentence: why it failed.")
    partial = models.BooleanField(default=False)
    stack_file = models.CharField(max_length=300, blank=True, help_text="Below the stacks folder.")
    stack_sha256 = models.CharField(max_length=64, blank=True)
    stack_removed_at = models.DateTimeField(
        null=True, blank=True, help_text="When the retention rule took the raw frames away; results stay."
    )
    acquisition = models.JSONField(default=dict, help_text="Time budget and link quality of the run.")

    class Meta:
        ordering = ["-queued_at", "-pk"]
        constraints = [
            models.UniqueConstraint(
                fields=["rig"], condition=Q(state__in=["running", "paused"], source="rig"), name="one_scan_on_a_rig"
            ),
        ]
        indexes = [
            models.Index(fields=["rig", "state", "position", "id"]),  # the worker's next job
            models.Index(fields=["state", "lease_until"]),  # the sweep for dead workers
            models.Index(fields=["region", "-finished_at"]),  # a region's trend
        ]

    def __str__(self) -> str:
        return f"{self.region} #{self.pk}"

    def get_absolute_url(self) -> str:
        return reverse("scan", args=[self.pk])

    @property
    def is_live(self) -> bool:
        return self.state in LIVE

    @property
    def is_on_rig(self) -> bool:
        return self.state in ON_RIG

    @property
    def has_ended(self) -> bool:
        return self.state in ENDED
