"""What happened: to a tool in the plant (Event), and in this program by whom (AuditEvent)."""

from __future__ import annotations

from django.conf import settings
from django.db import models

from inspection.models.insert_only import InsertOnly
from inspection.models.plant import Tool


class Event(models.Model):
    """Something done to a tool. Regrind and replacement end a wear segment: no trend crosses them."""

    class Kind(models.TextChoices):
        INSTALLED = "installed"
        TURNED = "turned"
        REGROUND = "reground"
        JOINTED = "jointed"
        COLLISION = "collision"
        REPLACED = "replaced"
        RECALIBRATED = "recalibrated"
        NOTE = "note"

    #: After these the edge is a new edge.
    SEGMENT_ENDS = (Kind.TURNED, Kind.REGROUND, Kind.REPLACED)

    tool = models.ForeignKey(Tool, on_delete=models.CASCADE, related_name="events")
    kind = models.CharField(max_length=12, choices=Kind)
    at = models.DateTimeField()
    life_used = models.FloatField(null=True, blank=True)
    removed_mm = models.FloatField(null=True, blank=True, help_text="Stock removed by a regrind.")
    note = models.CharField(max_length=300, blank=True)
    by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")

    class Meta:
        ordering = ["-at", "-pk"]
        indexes = [models.Index(fields=["tool", "-at"])]

    def __str__(self) -> str:
        return f"{self.tool.code} {self.kind} {self.at:%Y-%m-%d}"


class AuditEvent(InsertOnly):
    """Who changed what, when and why. Written by services in the same transaction as the change."""

    at = models.DateTimeField(auto_now_add=True)
    actor = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")
    verb = models.CharField(max_length=60)
    target_type = models.CharField(max_length=40)
    target_id = models.BigIntegerField(null=True)
    target = models.CharField(max_length=200)
    before = models.JSONField(null=True)
    after = models.JSONField(null=True)
    reason = models.CharField(max_length=300, blank=True)

    class Meta:
        ordering = ["-at", "-pk"]
        indexes = [models.Index(fields=["target_type", "target_id"])]

    def __str__(self) -> str:
        return f"{self.at:%Y-%m-%d %H:%M} {self.verb} {self.target}"
