"""Addresses of the downloads."""

from __future__ import annotations

from django.urls import path

from inspection.reports import views

urlpatterns = [
    path("scans.csv", views.scans_csv, name="report-scans"),
    path("measurements.csv", views.measurements_csv, name="report-measurements"),
    path("damages.csv", views.damages_csv, name="report-damages"),
    path("tools.csv", views.tools_csv, name="report-tools"),
    path("scans/<int:pk>/range.csv", views.range_csv, name="report-range"),
    path("inspections/<int:pk>/report.pdf", views.inspection_report, name="report-inspection"),
]
