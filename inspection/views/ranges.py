"""Range images as bytes for the browser's charts. Immutable: a result is never overwritten, so browsers keep it."""

from __future__ import annotations

import hashlib

from django.db.models import QuerySet
from django.http import Http404, HttpResponse, HttpResponseNotModified, JsonResponse
from django.views.decorators.http import require_safe

from inspection.models import RangeImage, Scan
from inspection.selectors.range_view import Picture, Window, cut, difference, picture, values, whole
from inspection.views.signed_in import SignedIn, found
from scanning.errors import BadInput, Fault

#: More cells than this along one side and a tablet stalls (a 500 x 600 map takes 0.24 s, 1000 x 1200 takes 0.74 s).
MOST_CELLS = 1200


def _image(request: SignedIn, pk: int, key: str = "result") -> RangeImage:
    scan = found(Scan, pk=pk)
    wanted = request.GET.get(key, "")
    images: QuerySet[RangeImage] = (
        RangeImage.objects.filter(scan=scan)
        if key == "result"
        else RangeImage.objects.filter(scan__region=scan.region_id)
    )
    if wanted:
        return found(images, pk=_whole(wanted, key))
    image = images.first()
    if image is None:
        raise Http404("This scan has no range image yet.")
    return image


def _whole(text: str, name: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise BadInput(f"{name}={text} is not a whole number from 0 up.")
    return int(text)


def _span(text: str, name: str, size: int) -> tuple[int, int]:
    """``12:300`` -> (12, 300), rows or profiles, half open."""
    if not text:
        return 0, size
    start, colon, end = text.partition(":")
    if not colon:
        raise BadInput(f"{name}={text} is not a span; write first:end, such as 0:{size}.")
    return _whole(start, name), min(_whole(end, name), size)


def _most(request: SignedIn) -> int:
    return max(2, min(MOST_CELLS, _whole(request.GET.get("max", "600"), "max")))


def _bad(fault: Fault) -> HttpResponse:
    return JsonResponse({"detail": str(fault)}, status=400)


def _bytes(drawn: Picture, headers: dict[str, str]) -> HttpResponse:
    counts = drawn.counts.astype("<i2").tobytes()
    return HttpResponse(counts, content_type="application/octet-stream", headers={**drawn.headers(), **headers})


@require_safe
def scan_range(request: SignedIn, pk: int) -> HttpResponse:
    """``range.i2``: little-endian int16, row by row; `Picture.headers` says what the counts mean."""
    try:
        image = _image(request, pk)
        asked = "&".join(f"{key}={request.GET.get(key, '')}" for key in ("channel", "rows", "cols", "max"))
        tag = f'"{hashlib.sha256(f"{image.sha256}?{asked}".encode()).hexdigest()[:32]}"'
        if request.headers.get("If-None-Match") == tag:
            return HttpResponseNotModified(headers={"ETag": tag})
        channel = request.GET.get("channel") or "level"
        row, row_end = _span(request.GET.get("rows", ""), "rows", image.rows)
        profile, profile_end = _span(request.GET.get("cols", ""), "cols", image.profiles)
        drawn = picture(
            values(image, channel), image, channel, Window(row, row_end, profile, profile_end), _most(request)
        )
    except Fault as fault:
        return _bad(fault)
    return _bytes(drawn, {"ETag": tag, "Cache-Control": "private, max-age=31536000, immutable"})


@require_safe
def scan_cut(request: SignedIn, pk: int) -> HttpResponse:
    try:
        image = _image(request, pk)
        row, profile = (_whole(request.GET.get(key, ""), key) for key in ("row", "col"))
        return JsonResponse(cut(image, request.GET.get("channel") or "level", row, profile))
    except Fault as fault:
        return _bad(fault)


@require_safe
def scan_difference(request: SignedIn, pk: int) -> HttpResponse:
    """Newer minus older, levelled, in the form of `scan_range`."""
    try:
        newer = _image(request, pk)
        older = _image(request, pk, "with")
        changed = difference(newer, older)
        drawn = picture(changed, newer, "level", whole(newer), _most(request))
    except Fault as fault:
        return _bad(fault)
    return _bytes(drawn, {"Cache-Control": "private, max-age=3600"})
