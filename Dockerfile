# The editor as a container, for the CPU or for an NVIDIA GPU; docs/how-to/serving.md says how to run it:
#   docker build --tag splatgraft .
#   docker build --tag splatgraft:cuda --build-arg DEVICE=cuda .
# Written without Docker at hand: this build has not been run yet.
ARG DEVICE=cpu
# the release of CUDA for which PyPI's wheel of torch was made
ARG CUDA_VERSION=13.0.1

FROM python:3.11-slim-bookworm AS cpu
ENV EXTRAS=sfm,spz PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
# OpenMP for torch and numba
RUN apt-get update && apt-get install --yes --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*

# with nvcc and a C++ compiler: gsplat compiles its kernels on first use
FROM nvidia/cuda:${CUDA_VERSION}-devel-ubuntu24.04 AS cuda
ENV EXTRAS=cuda,sfm,spz
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 python3-dev python3-venv libgomp1 \
    && rm -rf /var/lib/apt/lists/*

FROM ${DEVICE}
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 OMP_WAIT_POLICY=passive \
    PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NUMBA_CACHE_DIR=/tmp/numba TORCH_EXTENSIONS_DIR=/tmp/torch_extensions
WORKDIR /opt/splatgraft
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY src ./src
RUN python3 -m venv /opt/venv && pip install --constraint constraints.txt ".[$EXTRAS]"
RUN useradd --create-home splatgraft && mkdir /projects && chown splatgraft /projects
USER splatgraft
WORKDIR /projects
VOLUME /projects
EXPOSE 8080
ENTRYPOINT ["splatgraft"]
CMD ["edit", "/projects", "--host", "0.0.0.0", "--port", "8080", "--keep-closed"]
