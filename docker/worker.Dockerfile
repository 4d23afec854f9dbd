# What runs imports and registrations: the engine and a worker that forks a process a job.
#   docker build -f docker/worker.Dockerfile -t regnf-worker .
# Where the default package index offers GPU builds of torch first, give an index of CPU builds beside it and the image
# shrinks by gigabytes:  --build-arg PIP_EXTRA_INDEX_URL=...
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
ARG PIP_EXTRA_INDEX_URL=""
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/regnf
ENV PATH=/opt/regnf/bin:$PATH
WORKDIR /source
COPY constraints.txt ./
# torch first, by itself and by its pinned version: the layer is the largest by far and outlives changes of everything
# below, and an open range may resolve to another build.
RUN pip install --constraint constraints.txt torch
COPY --from=wheel /wheels /wheels
RUN pip install --constraint constraints.txt "$(echo /wheels/regnf-*.whl)[engine,service]"

FROM ${BASE}
# What open3d and torch load. Versions come with the pinned release of the base image.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
       libegl1 libgl1 libgomp1 libidn2-0 libudev1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
RUN groupadd --system --gid 10001 regnf \
    && useradd --system --uid 10001 --gid regnf --home-dir /tmp --no-create-home regnf \
    && install --directory --owner regnf --group regnf --mode 0750 /var/lib/regnf
COPY --from=build /opt/regnf /opt/regnf
COPY docker/worker_health.py /opt/regnf/worker_health.py
# Threads that wait must not spin: several workers share the cores.
ENV PATH=/opt/regnf/bin:$PATH \
    HOME=/tmp \
    OMP_WAIT_POLICY=PASSIVE \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    REGNF_STATE_DIR=/var/lib/regnf
USER 10001:10001
WORKDIR /var/lib/regnf
VOLUME ["/var/lib/regnf"]
HEALTHCHECK --interval=30s --timeout=10s --start-period=30s --retries=3 \
    CMD ["python", "/opt/regnf/worker_health.py"]
CMD ["python", "-m", "regnf_worker.main"]
