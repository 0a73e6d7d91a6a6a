# One image for web, workers and tick. Built and run on no Docker engine so far: see docs/deployment.md.
FROM python:3.12-slim AS base
ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=0 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    EDGEWATCH_HOME=/data NUMBA_CACHE_DIR=/data/numba
WORKDIR /app
COPY requirements.txt .
RUN pip install --require-hashes -r requirements.txt
COPY manage.py ./
COPY scanning scanning
COPY inspection inspection
COPY worker worker
COPY templates templates
RUN useradd --system --uid 10001 --home /data edgewatch && mkdir /data && chown edgewatch /data
USER edgewatch
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=30s --timeout=5s CMD python -c "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/health/', timeout=4)"
CMD ["gunicorn", "inspection.wsgi:application", "--bind", "0.0.0.0:8000", "--workers", "2", "--threads", "4", "--access-logfile", "-"]
