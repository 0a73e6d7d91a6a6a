"""What measures, and by which rules: rigs, calibrations, recipes and limit sets."""

from __future__ import annotations

import datetime as dt

from django.conf import settings
from django.db import models
from django.urls import reverse
from django.utils import timezone

from inspection.models.insert_only import InsertOnly
from inspection.models.plant import ToolType
from inspection.states import QueueState


class Rig(models.Model):
    """One stage, camera and laser, with one queue.

    ``config`` is what `scanning.rig.open_rig` takes: drivers, port, address, optics. ``system`` names the imaging
    system (IS1, IS2). The queue's state carries its reason and owner, because a queue that waits without saying why is
    the most common complaint about products like this one.
    """

    slug = models.SlugField(unique=True)
    name = models.CharField(max_length=80)
    config = models.JSONField(default=dict)
    travel_mm = models.FloatField(default=100.0)
    exposures_us = models.JSONField(default=list, help_text="Bracket used unless the order says otherwise.")
    active = models.BooleanField(default=True)
    queue_state = models.CharField(max_length=8, choices=QueueState, default=QueueState.READY)
    queue_reason = models.CharField(max_length=300, blank=True)
    queue_owner = models.ForeignKey(
        settings.AUTH_USER_MODEL, null=True, blank=True, on_delete=models.SET_NULL, related_name="+"
    )
    queue_since = models.DateTimeField(null=True, blank=True)
    pause_under_lock = models.CharField(
        max_length=300,
        blank=True,
        help_text="Why the queue was paused before the rig was locked; unlocking brings it back.",
    )
    worker_seen_at = models.DateTimeField(null=True, blank=True)

    class Meta:
        ordering = ["slug"]

    def __str__(self) -> str:
        return self.name

    def get_absolute_url(self) -> str:
        return reverse("queue", args=[self.slug])

    def calibration_now(self) -> Calibration | None:
        """The newest calibration of this rig, expired or not; None if there never was one."""
        return self.calibrations.order_by("-done_on", "-pk").first()


class Calibration(InsertOnly):
    """A line height = intercept + slope x column, fitted to gauge pairs on one day, with what it is worth.

    ``fit`` is `scanning.calibration`'s JSON in full (covariance, residuals, leave-one-out, range); the columns repeat
    what lists and reports show. Lengths in the unit of the name.
    """

    rig = models.ForeignKey(Rig, on_delete=models.PROTECT, related_name="calibrations")
    done_on = models.DateField()
    valid_until = models.DateField()
    by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    artefact = models.CharField(max_length=200, help_text="The gauge and its certificate.")
    pairs = models.JSONField(help_text="[[height_mm, column_px], ...] as uploaded.")
    fit = models.JSONField()
    slope_mm_per_px = models.FloatField()
    intercept_mm = models.FloatField()
    u_slope_mm_per_px = models.FloatField()
    max_residual_um = models.FloatField()
    residual_sd_um = models.FloatField()
    leave_one_out_um = models.FloatField()
    low_mm = models.FloatField()
    high_mm = models.FloatField()
    note = models.TextField(blank=True)
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ["-done_on", "-pk"]

    def __str__(self) -> str:
        return f"{self.rig.slug} {self.done_on:%Y-%m-%d}"

    def get_absolute_url(self) -> str:
        return reverse("calibration", args=[self.pk])

    def expired(self, on: dt.date | None = None) -> bool:
        return (on or timezone.localdate()) > self.valid_until


class Recipe(InsertOnly):
    """A `scanning.Recipe` in full, kept once per content."""

    name = models.CharField(max_length=60)
    definition = models.JSONField()
    sha256 = models.CharField(max_length=64, unique=True)
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ["name", "pk"]

    def __str__(self) -> str:
        return self.name


class LimitSet(InsertOnly):
    """The limits in force for a tool type from one moment on. Changing limits adds a set, with a reason."""

    tool_type = models.ForeignKey(ToolType, on_delete=models.PROTECT, related_name="limit_sets")
    version = models.PositiveIntegerField()
    by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    reason = models.CharField(max_length=300)
    created_at = models.DateTimeField(auto_now_add=True)

    class Meta:
        ordering = ["-version"]
        constraints = [models.UniqueConstraint(fields=["tool_type", "version"], name="limit_set_version_unique")]

    def __str__(self) -> str:
        return f"{self.tool_type} limits v{self.version}"


class Limit(InsertOnly):
    """One metric's limits: above ``watch_above`` keep an eye on it, above ``replace_above`` take it out."""

    limit_set = models.ForeignKey(LimitSet, on_delete=models.PROTECT, related_name="limits")
    metric = models.CharField(max_length=30)
    watch_above = models.FloatField(null=True, blank=True)
    replace_above = models.FloatField(null=True, blank=True)
    unit = models.CharField(max_length=12)

    class Meta:
        ordering = ["metric"]
        constraints = [models.UniqueConstraint(fields=["limit_set", "metric"], name="limit_once_per_metric")]

    def __str__(self) -> str:
        return f"{self.metric} watch {self.watch_above} replace {self.replace_above} {self.unit}"
