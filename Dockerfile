# vrspray in a container, for 64-bit x86 and ARM; one image for each role of a computer.
#
#   docker build --tag vrspray .                                  on the vehicle
#   docker build --tag vrspray-office --build-arg ROLE=office .   pictures, reports, exports, upload
#   docker buildx build --platform linux/amd64,linux/arm64 --tag REGISTRY/vrspray:0.1.0 --push .
#
# Without arguments the image flies the demo. Any other command follows its name; the examples lie in
# the folder where it starts:
#   docker run --rm vrspray
#   docker run --rm --network host --volume "$PWD/flight:/data" vrspray run --config /data/config.toml
#   docker run --rm --volume "$PWD/flight:/data" vrspray-office report /data/flights/flight-0001.gpkg --out /data/report
# Make the folder first; it must belong to user 1000, as whom everything here runs.
#
# What `run` needs of the computer, each only where it is used; a group is given by its number:
#   the autopilot by UDP, TCP       --network host
#   the autopilot by a serial line  --device /dev/ttyAMA0 --group-add "$(stat -c %g /dev/ttyAMA0)"
#   valves on the computer's lines  --device /dev/gpiochip0 --group-add "$(stat -c %g /dev/gpiochip0)"
#                                   --ulimit rtprio=50 --ulimit memlock=-1 --cap-add SYS_NICE
#   gauges on an I2C bus            --device /dev/i2c-1 --group-add "$(stat -c %g /dev/i2c-1)"
# With valves on the computer's lines, prefer `vrspray service install` without a container: there
# systemd closes the lines after every end of the companion (docs/howto/run-as-a-service.md). Here only the valve
# engine and your hardware do.

FROM python:3.13-slim AS build
ARG ROLE=vehicle
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/vrspray
ENV PATH=/opt/vrspray/bin:$PATH
WORKDIR /src
COPY requirements/build.txt requirements/vehicle.txt requirements/office.txt requirements/
RUN pip install --require-hashes -r requirements/build.txt -r "requirements/$ROLE.txt"
COPY pyproject.toml README.md LICENSE ./
COPY companion companion
COPY missions missions
COPY sitl sitl
COPY analysis analysis
COPY examples examples
COPY deploy deploy
# Compiled here: the user who runs it may write nothing beside it.
RUN pip install --no-deps --no-build-isolation . \
 && pip uninstall --yes setuptools pip \
 && python -m compileall -q --invalidation-mode unchecked-hash /opt/vrspray/lib

FROM python:3.13-slim
LABEL org.opencontainers.image.title="vrspray" \
      org.opencontainers.image.description="Variable-rate spraying companion for ArduPilot and PX4" \
      org.opencontainers.image.version="0.1.0" \
      org.opencontainers.image.licenses="Apache-2.0"
# For BlueOS, which reads these and starts the container by `permissions`, in Docker's own words.
LABEL version="0.1.0" \
      type="device-integration" \
      requirements="core >= 1.1" \
      tags='["agriculture", "spraying", "companion"]' \
      authors='[{"name": "The vrspray contributors", "email": ""}]' \
      company='{"about": "Variable-rate spraying companion for ArduPilot and PX4", "name": "vrspray", "email": ""}' \
      readme="" \
      links='{}' \
      permissions='{"Cmd": ["run", "--config", "/data/config.toml"], "HostConfig": {"NetworkMode": "host", "Binds": ["/usr/blueos/extensions/vrspray:/data"]}}'
COPY --from=build /opt/vrspray /opt/vrspray
ENV PATH=/opt/vrspray/bin:$PATH \
    PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 MPLBACKEND=Agg \
    VRSPRAY_ALIVE_FILE=/dev/shm/vrspray.alive
RUN useradd --create-home --uid 1000 vrspray \
 && install --directory --owner vrspray /data \
 && vrspray examples copy anyang --to /home/vrspray/examples
USER 1000
WORKDIR /home/vrspray
VOLUME /data
# The control loop of `run` touches the file once a second: it must not have stood still for long.
# Other commands have no such file.
HEALTHCHECK --interval=15s --timeout=5s --start-period=120s --retries=2 \
    CMD ["sh", "-c", "test ! -e $VRSPRAY_ALIVE_FILE || find $VRSPRAY_ALIVE_FILE -newermt '-5 seconds' | grep -q ."]
# SIGINT ends every command in order, valves closed; as process 1 the demo would ignore SIGTERM.
STOPSIGNAL SIGINT
ENTRYPOINT ["vrspray"]
CMD ["demo", "--out", "/home/vrspray/demo-out"]
