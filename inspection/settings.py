"""Django settings. Everything a site changes comes from the environment (docs/deployment.md lists the names)."""

from __future__ import annotations

import os
from pathlib import Path

import dj_database_url

from inspection.environment import envbool, envint, envlist, secret

BASE_DIR = Path(__file__).resolve().parent.parent

#: Where the database, stacks, range images and run files of this installation live.
HOME = Path(os.environ.get("EDGEWATCH_HOME", BASE_DIR / "var")).resolve()
STACKS = HOME / "stacks"
RANGES = HOME / "ranges"
UPLOADS = HOME / "uploads"

DEBUG = envbool("DEBUG", False)
SECRET_KEY = secret("SECRET_KEY", HOME / "secret-key")
ALLOWED_HOSTS = envlist("ALLOWED_HOSTS", ["localhost", "127.0.0.1", "[::1]"])
CSRF_TRUSTED_ORIGINS = envlist("CSRF_TRUSTED_ORIGINS", [])
BEHIND_TLS = envbool("BEHIND_TLS", False)
SECURE_PROXY_SSL_HEADER = ("HTTP_X_FORWARDED_PROTO", "https") if BEHIND_TLS else None
SESSION_COOKIE_SECURE = CSRF_COOKIE_SECURE = SECURE_SSL_REDIRECT = BEHIND_TLS
SECURE_HSTS_SECONDS = 3600 if BEHIND_TLS else 0
SECURE_HSTS_INCLUDE_SUBDOMAINS = BEHIND_TLS
#: A host inside a mill is never on the browsers' public preload list.
SILENCED_SYSTEM_CHECKS = ["security.W021"]
SESSION_COOKIE_AGE = 12 * 3600
X_FRAME_OPTIONS = "DENY"

INSTALLED_APPS = [
    "django.contrib.auth",
    "django.contrib.contenttypes",
    "django.contrib.sessions",
    "django.contrib.messages",
    "whitenoise.runserver_nostatic",
    "django.contrib.staticfiles",
    "django_htmx",
    "ninja",  # for its own copy of the API page's scripts: no page may need the internet
    "inspection",
]
MIDDLEWARE = [
    "django.middleware.security.SecurityMiddleware",
    "inspection.middleware.ContentSecurityPolicy",
    "whitenoise.middleware.WhiteNoiseMiddleware",
    "django.contrib.sessions.middleware.SessionMiddleware",
    "django.middleware.common.CommonMiddleware",
    "django.middleware.csrf.CsrfViewMiddleware",
    "django.contrib.auth.middleware.AuthenticationMiddleware",
    "django.contrib.messages.middleware.MessageMiddleware",
    "django.middleware.clickjacking.XFrameOptionsMiddleware",
    "django_htmx.middleware.HtmxMiddleware",
    "inspection.middleware.RoleGate",
    "inspection.middleware.PlainText",
]
CSRF_FAILURE_VIEW = "inspection.views.errors.forged"
ROOT_URLCONF = "inspection.urls"
WSGI_APPLICATION = "inspection.wsgi.application"
TEMPLATES = [
    {
        "BACKEND": "django.template.backends.django.DjangoTemplates",
        "DIRS": [BASE_DIR / "templates"],
        "OPTIONS": {
            "context_processors": [
                "django.template.context_processors.request",
                "django.contrib.auth.context_processors.auth",
                "django.contrib.messages.context_processors.messages",
            ]
        },
    }
]

DATABASES = {"default": dj_database_url.config(default=f"sqlite:///{HOME / 'edgewatch.sqlite3'}", conn_max_age=60)}
if DATABASES["default"]["ENGINE"].endswith("sqlite3"):
    # IMMEDIATE is what ends "database is locked" (patterns.md 0.4); persistent connections buy nothing on a file.
    DATABASES["default"]["CONN_MAX_AGE"] = 0
    DATABASES["default"]["OPTIONS"] = {
        "transaction_mode": "IMMEDIATE",
        "timeout": 20,
        "init_command": "PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL; PRAGMA busy_timeout=20000;",
    }

AUTH_USER_MODEL = "inspection.User"
LOGIN_URL = "sign-in"
LOGIN_REDIRECT_URL = "overview"
LOGOUT_REDIRECT_URL = "sign-in"
AUTH_PASSWORD_VALIDATORS = [
    {"NAME": "django.contrib.auth.password_validation.UserAttributeSimilarityValidator"},
    {"NAME": "django.contrib.auth.password_validation.MinimumLengthValidator", "OPTIONS": {"min_length": 10}},
    {"NAME": "django.contrib.auth.password_validation.CommonPasswordValidator"},
]

USE_TZ = True
TIME_ZONE = os.environ.get("TIME_ZONE", "UTC")
USE_I18N = True
LANGUAGE_CODE = "en"

#: Printed at the head of every report.
PLANT_NAME = os.environ.get("PLANT_NAME", "")

STATIC_URL = "static/"
STATIC_ROOT = HOME / "static"
STATICFILES_FINDERS = [
    "django.contrib.staticfiles.finders.AppDirectoriesFinder",
    "inspection.staticfinder.PlotlyFinder",
]
STORAGES = {
    "default": {"BACKEND": "django.core.files.storage.FileSystemStorage", "OPTIONS": {"location": UPLOADS}},
    "staticfiles": {"BACKEND": "whitenoise.storage.CompressedManifestStaticFilesStorage"},
}
DATA_UPLOAD_MAX_MEMORY_SIZE = 10 * 2**20
DATA_UPLOAD_MAX_NUMBER_FILES = 5000
#: A stack arrives as one upload of many files; larger ones are imported from the command line.
STACK_UPLOAD_MAX_BYTES = envint("STACK_UPLOAD_MAX_MB", 2048) * 2**20

#: Raw frames of finished scans are removed after so many days; 0 keeps them for ever. Results are never removed.
STACK_KEEP_DAYS = envint("STACK_KEEP_DAYS", 0)

#: Redis or Valkey: a doorbell, never the truth. `manage.py up` starts one on a unix socket and sets this.
REDIS_URL = os.environ.get("REDIS_URL", f"redis+socket://{HOME / 'run' / 'valkey.sock'}")

LOGGING = {
    "version": 1,
    "disable_existing_loggers": False,
    "formatters": {"line": {"format": "{asctime} {levelname} {name} {message}", "style": "{"}},
    "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "line"}},
    "root": {"handlers": ["stderr"], "level": os.environ.get("LOG_LEVEL", "INFO")},
}
