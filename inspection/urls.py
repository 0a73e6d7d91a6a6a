"""All addresses, grouped by what they are about. `inspection/roles.py` says who may use which."""

from __future__ import annotations

from django.urls import URLPattern, URLResolver, include, path

from inspection.api import api
from inspection.health import health
from inspection.views import (
    again,
    calibrations,
    imports,
    overview,
    people,
    ranges,
    records,
    rigs,
    rules,
    scans,
    schedules,
    tools,
)

tool_urls = [
    path("new/", tools.tool_new, name="tool-new"),
    path("<int:pk>/", tools.tool_page, name="tool"),
    path("<int:pk>/edit/", tools.tool_edit, name="tool-edit"),
    path("<int:pk>/trend.json", tools.tool_trend, name="tool-trend"),
    path("<int:pk>/event/", tools.tool_event, name="tool-event"),
    path("<int:pk>/scan/", tools.scan_order, name="scan-order"),
    path("<int:pk>/regions/new/", tools.region_new, name="region-new"),
    path("<int:pk>/regions/<int:region_pk>/", tools.region_edit, name="region-edit"),
]
scan_urls = [
    path("<int:pk>/", scans.scan_page, name="scan"),
    path("<int:pk>/progress/", scans.scan_progress, name="scan-progress"),
    path("<int:pk>/range.i2", ranges.scan_range, name="scan-range"),
    path("<int:pk>/cut.json", ranges.scan_cut, name="scan-cut"),
    path("<int:pk>/compare/", scans.scan_compare, name="scan-compare"),
    path("<int:pk>/difference.i2", ranges.scan_difference, name="scan-difference"),
    path("<int:pk>/cancel/", scans.scan_cancel, name="scan-cancel"),
    path("<int:pk>/pause/", scans.scan_pause, name="scan-pause"),
    path("<int:pk>/resume/", scans.scan_resume, name="scan-resume"),
    path("<int:pk>/finish/", scans.scan_finish, name="scan-finish"),
    path("<int:pk>/again/", scans.scan_again, name="scan-again"),
    path("<int:pk>/continue/", scans.scan_continue, name="scan-continue"),
    path("<int:pk>/reprocess/", scans.scan_reprocess, name="scan-reprocess"),
]
rig_urls = [
    path("", rigs.rigs_page, name="rigs"),
    path("<slug:slug>/", rigs.queue_page, name="queue"),
    path("<slug:slug>/rows/", rigs.queue_rows, name="queue-rows"),
    path("<slug:slug>/move/<int:pk>/", rigs.queue_move, name="queue-move"),
    path("<slug:slug>/pause/", rigs.queue_pause, name="queue-pause"),
    path("<slug:slug>/resume/", rigs.queue_resume, name="queue-resume"),
    path("<slug:slug>/lock/", rigs.queue_lock, name="queue-lock"),
    path("<slug:slug>/unlock/", rigs.queue_unlock, name="queue-unlock"),
    path("<slug:slug>/stop/", rigs.queue_stop, name="queue-stop"),
    path("<slug:slug>/cart/", rigs.queue_cart, name="queue-cart"),
]
again_urls = [
    path("", again.again_page, name="again"),
    path("<int:pk>/", again.batch_page, name="again-batch"),
    path("<int:pk>/cancel/", again.batch_cancel, name="again-cancel"),
    path("<int:pk>/resume/", again.batch_resume, name="again-resume"),
]
rule_urls = [
    path("calibrations/", calibrations.calibrations_page, name="calibrations"),
    path("calibrations/new/", calibrations.calibration_new, name="calibration-new"),
    path("calibrations/<int:pk>/", calibrations.calibration_page, name="calibration"),
    path("recipes/", rules.recipes_page, name="recipes"),
    path("recipes/<int:pk>/", rules.recipe_page, name="recipe"),
    path("limits/", rules.limits_page, name="limits"),
    path("limits/<int:pk>/", rules.limits_history, name="limits-history"),
    path("limits/<int:pk>/edit/", rules.limits_edit, name="limits-edit"),
    path("tool-types/new/", tools.tool_type_new, name="tool-type-new"),
    path("tool-types/<int:pk>/", tools.tool_type_edit, name="tool-type-edit"),
]
people_urls = [
    path("sign-in/", people.sign_in, name="sign-in"),
    path("sign-out/", people.sign_out, name="sign-out"),
    path("me/password/", people.own_password, name="own-password"),
    path("people/", people.people_page, name="people"),
    path("people/new/", people.person_new, name="person-new"),
    path("people/<int:pk>/", people.person_edit, name="person-edit"),
]

urlpatterns: list[URLPattern | URLResolver] = [
    path("", overview.overview_page, name="overview"),
    path("lookup/", overview.tool_lookup, name="tool-lookup"),
    path("tools/", include(tool_urls)),
    path("inspections/<int:pk>/", scans.inspection_page, name="inspection"),
    path("scans/", include(scan_urls)),
    path("rigs/", include(rig_urls)),
    path("again/", include(again_urls)),
    path("", include(rule_urls)),
    path("schedules/", schedules.schedules_page, name="schedules"),
    path("schedules/new/", schedules.schedule_new, name="schedule-new"),
    path("schedules/<int:pk>/", schedules.schedule_edit, name="schedule-edit"),
    path("import/", imports.import_page, name="import"),
    path("", include(people_urls)),
    path("reports/", include("inspection.reports.urls")),
    path("api/v1/", api.urls),
    path("audit/", records.audit_page, name="audit"),
    path("health/", health, name="health"),
    path("status/", records.health_page, name="health-page"),
    path("help/", records.help_page, name="help"),
]

handler403 = "inspection.views.errors.forbidden"
handler404 = "inspection.views.errors.not_found"
