# sadgs in a container. In a checkout, and then in the folder that holds PHOTOS:
#   docker build -t sadgs .
#   docker run --rm --gpus all -v "$PWD:/data" -v sadgs-cache:/cache sadgs sadgs PHOTOS --formats html,ply
# The host needs NVIDIA's driver and its container toolkit. /cache keeps compiled kernels and downloads for later runs.
FROM debian:bookworm-slim

# Triton compiles with gcc and Python's headers. Meshes need OpenGL's libraries.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        ca-certificates gcc libc6-dev libegl1 libgl1 python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/sadgs
COPY constraints.txt LICENSE pyproject.toml README.md ./
COPY sadgs_ns sadgs_ns
RUN python3 -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir . -c constraints.txt

# nerfstudio asks for the user's name, which a container may lack.
ENV PATH=/opt/venv/bin:$PATH \
    USER=sadgs \
    XDG_CACHE_HOME=/cache \
    TRITON_CACHE_DIR=/cache/triton \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /data
CMD ["sadgs", "--help"]
