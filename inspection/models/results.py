"""What a scan gave. Results are added, never overwritten: reprocessing adds a range image beside the old one."""

from __future__ import annotations

from django.conf import settings
from django.db import models
from django.urls import reverse

from inspection.models.insert_only import InsertOnly
from inspection.models.rigs import Calibration, LimitSet, Recipe
from inspection.models.scans import Scan
from inspection.states import Verdict


class RangeImage(InsertOnly):
    """One range image computed from one scan's stack, with everything it was computed by.

    ``file`` is an npz below the ranges folder (contract 3 of the design), ``sha256`` its hash. The newest range image
    of a scan is the one shown.
    """

    scan = models.ForeignKey(Scan, on_delete=models.PROTECT, related_name="range_images")
    recipe = models.ForeignKey(Recipe, on_delete=models.PROTECT, related_name="range_images")
    calibration = models.ForeignKey(Calibration, null=True, on_delete=models.PROTECT, related_name="range_images")
    limit_set = models.ForeignKey(LimitSet, null=True, on_delete=models.PROTECT, related_name="range_images")
    baseline = models.ForeignKey("self", null=True, on_delete=models.PROTECT, related_name="compared")
    created_at = models.DateTimeField()
    file = models.CharField(max_length=300)
    sha256 = models.CharField(max_length=64)
    rows = models.PositiveIntegerField()
    profiles = models.PositiveIntegerField()
    row_pitch_um = models.FloatField()
    profile_pitch_um = models.FloatField()
    provenance = models.JSONField()
    surface = models.JSONField(default=dict, help_text="Plane, noise, edge and warnings of the surface report.")
    verdict = models.CharField(max_length=8, choices=Verdict, default=Verdict.UNKNOWN)
    verdict_reasons = models.JSONField(default=list, help_text="Sentences: which metric, value, limit.")

    class Meta:
        ordering = ["-created_at", "-pk"]
        indexes = [models.Index(fields=["scan", "-created_at"])]

    def __str__(self) -> str:
        return f"range image {self.pk} of {self.scan}"

    def get_absolute_url(self) -> str:
        return reverse("scan", args=[self.scan_id])


class Measurement(InsertOnly):
    """One number about a region, with its unit, its standard uncertainty and where it came from."""

    range_image = models.ForeignKey(RangeImage, on_delete=models.PROTECT, related_name="measurements")
    metric = models.CharField(max_length=30)
    label = models.CharField(max_length=80)
    value = models.FloatField(null=True)
    unit = models.CharField(max_length=12, blank=True)
    u = models.FloatField(null=True, help_text="Standard uncertainty, in the same unit.")
    origin = models.CharField(max_length=300, blank=True)

    class Meta:
        ordering = ["pk"]
        constraints = [models.UniqueConstraint(fields=["range_image", "metric"], name="metric_once_per_range_image")]
        indexes = [models.Index(fields=["metric", "range_image"])]  # trends of one metric

    def __str__(self) -> str:
        return f"{self.metric} {self.value} {self.unit}"


class Damage(InsertOnly):
    """One instance of missing material."""

    range_image = models.ForeignKey(RangeImage, on_delete=models.PROTECT, related_name="damages")
    number = models.PositiveIntegerField()
    severity = models.CharField(max_length=8)
    volume_mm3 = models.FloatField()
    u_volume_mm3 = models.FloatField(null=True)
    depth_um = models.FloatField()
    u_depth_um = models.FloatField(null=True)
    area_mm2 = models.FloatField()
    length_mm = models.FloatField()
    start_mm = models.FloatField()
    end_mm = models.FloatField()
    touches_edge = models.BooleanField()
    detail = models.JSONField(default=dict, help_text="The finding in full, from the surface report.")

    class Meta:
        ordering = ["number"]
        constraints = [models.UniqueConstraint(fields=["range_image", "number"], name="damage_numbered_once")]

    def __str__(self) -> str:
        return f"damage {self.number} of range image {self.range_image_id}"


class PrecisionReport(InsertOnly):
    """How good a range image is: the paper's four figures, sigma always with the lateral cell it belongs to."""

    range_image = models.OneToOneField(RangeImage, on_delete=models.PROTECT, related_name="precision")
    undefined_count = models.PositiveBigIntegerField()
    undefined_share = models.FloatField()
    saturated_count = models.PositiveBigIntegerField()
    saturated_share = models.FloatField()
    sigma_um = models.FloatField(null=True)
    cell_scan_um = models.FloatField()
    cell_row_um = models.FloatField()
    ns_per_range_pixel = models.FloatField(null=True, help_text="None where nothing was computed from frames.")
    cpu_ns_per_range_pixel = models.FloatField(null=True)
    detail = models.JSONField(default=dict)

    def __str__(self) -> str:
        return f"precision of range image {self.range_image_id}"

    @property
    def confident_share(self) -> float | None:
        """Share of the measured points whose confidence is above ``confident_above``; None where it was not told."""
        return self._told("confident", "share")

    @property
    def confident_above(self) -> float | None:
        return self._told("confident", "above")

    @property
    def outside_calibrated_share(self) -> float | None:
        """Share of the heights that are extrapolated beyond the gauge; None without a gauge."""
        return self._told("outside_calibrated", "share")

    def _told(self, figure: str, name: str) -> float | None:
        """A number of ``detail``; results from before there was such a figure do not have it."""
        told = self.detail.get(figure)
        value = told.get(name) if isinstance(told, dict) else None
        return float(value) if isinstance(value, (int, float)) else None


class RecomputationBatch(models.Model):
    """Many scans to be computed again with one recipe. How far it is stands in its orders, nowhere else."""

    recipe = models.ForeignKey(Recipe, on_delete=models.PROTECT, related_name="+")
    reason = models.CharField(max_length=200)
    requested_by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    requested_at = models.DateTimeField()

    class Meta:
        ordering = ["-requested_at", "-pk"]

    def __str__(self) -> str:
        return f"batch {self.pk} with {self.recipe}"

    def get_absolute_url(self) -> str:
        return reverse("again-batch", args=[self.pk])


class Recomputation(models.Model):
    """An order to compute a scan's result again with a recipe. The row is the order; the message only rings for it."""

    class State(models.TextChoices):
        QUEUED = "queued"
        RUNNING = "running"
        DONE = "done"
        FAILED = "failed"
        CANCELLED = "cancelled"

    scan = models.ForeignKey(Scan, on_delete=models.PROTECT, related_name="recomputations")
    recipe = models.ForeignKey(Recipe, on_delete=models.PROTECT, related_name="+")
    requested_by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    requested_at = models.DateTimeField()
    batch = models.ForeignKey(RecomputationBatch, null=True, on_delete=models.PROTECT, related_name="orders")
    state = models.CharField(max_length=9, choices=State, default=State.QUEUED)
    attempts = models.PositiveIntegerField(default=0)
    started_at = models.DateTimeField(null=True, blank=True)
    lease_until = models.DateTimeField(null=True, blank=True, help_text="Its worker is alive until then.")
    finished_at = models.DateTimeField(null=True, blank=True)
    fault = models.CharField(max_length=500, blank=True)
    range_image = models.OneToOneField(
        RangeImage, null=True, blank=True, on_delete=models.PROTECT, related_name="recomputation"
    )

    class Meta:
        ordering = ["-requested_at", "-pk"]
        indexes = [
            models.Index(fields=["state", "requested_at"]),  # the tick's list of what still waits
            models.Index(fields=["batch", "state"]),  # a batch's progress
        ]

    def __str__(self) -> str:
        return f"{self.scan} again with {self.recipe}"
