# The HTTP front end: contract, routes, storage, queue client, page. It never loads torch, and torch is not in here.
#   docker build -f docker/service.Dockerfile -t regnf-service .
# BASE is any Debian 12 with Python 3.11, its venv module and `python` in the path.
ARG BASE=python:3.11-slim-bookworm

# The project as a wheel: what the images hold is what `pip install regnf` would bring. The compiler makes the native
# evaluator, and stays in this stage. Versions come with the pinned release of the base image.
FROM ${BASE} AS wheel
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/build
WORKDIR /source
COPY . .
RUN /opt/build/bin/pip wheel --no-deps --wheel-dir /wheels .

FROM ${BASE} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/regnf
ENV PATH=/opt/regnf/bin:$PATH
WORKDIR /source
COPY constraints.txt ./
COPY --from=wheel /wheels /wheels
RUN pip install --constraint constraints.txt "$(echo /wheels/regnf-*.whl)[service]"

FROM ${BASE}
# The state folder belongs to the user, so that a fresh volume mounted there does as well.
RUN groupadd --system --gid 10001 regnf \
    && useradd --system --uid 10001 --gid regnf --home-dir /tmp --no-create-home regnf \
    && install --directory --owner regnf --group regnf --mode 0750 /var/lib/regnf
COPY --from=build /opt/regnf /opt/regnf
COPY docker/serve_api.py /opt/regnf/serve_api.py
# A container's loopback is of no use to anyone outside it. Listening elsewhere needs REGNF_BEHIND_PROXY=true, and
# REGNF_API_TOKENS, REGNF_PUBLISH on the host's loopback, or REGNF_ALLOW_UNAUTHENTICATED=true.
ENV PATH=/opt/regnf/bin:$PATH \
    HOME=/tmp \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    REGNF_HOST=0.0.0.0 \
    REGNF_PORT=8080 \
    REGNF_STATE_DIR=/var/lib/regnf
USER 10001:10001
WORKDIR /var/lib/regnf
VOLUME ["/var/lib/regnf"]
EXPOSE 8080
HEALTHCHECK --interval=15s --timeout=5s --start-period=20s --retries=3 \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8080/healthz', timeout=4)"]
CMD ["python", "/opt/regnf/serve_api.py"]
