# makebreak on Debian slim, with the packages of requirements.lock.
#
#   docker build -t makebreak .
#   docker run --rm -v "$PWD:/data" makebreak gap ROBOT.urdf LOG.csv --out first
#   docker run --rm -p 7000:7000 makebreak run            # seen at localhost:7000
FROM debian:bookworm-slim

# What scripts/setup.sh would find missing; here, so that this layer is kept when the
# project changes.
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
        libx11-6 libsm6 libglib2.0-0 libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*

# Numba's code is for the processor that compiled it; the image may run on another.
ENV NUMBA_CPU_NAME=generic PATH=/opt/makebreak/.venv/bin:$PATH
WORKDIR /opt/makebreak
COPY . .
RUN scripts/setup.sh --compile
# What `gap` compiles at its first run; a container of `docker run --rm` keeps nothing.
RUN cd "$(mktemp -d)" && python /opt/makebreak/examples/gap_of_an_arm.py

WORKDIR /data
ENTRYPOINT ["makebreak"]
CMD ["--help"]
