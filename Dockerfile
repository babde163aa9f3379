# Without arguments the image flies the demo:
#   docker build -t vrspray . && docker run --rm vrspray
# Any other command follows the image's name:
#   docker run --rm --network host -v "$PWD/flight:/home/vrspray/flight" vrspray \
#       run --config flight/config.toml

FROM python:3.11-slim AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/vrspray
ENV PATH=/opt/vrspray/bin:$PATH
WORKDIR /opt/vrspray/src
COPY requirements/build.txt requirements/plot.txt requirements/
RUN pip install --require-hashes -r requirements/build.txt -r requirements/plot.txt
COPY pyproject.toml README.md LICENSE ./
COPY companion companion
COPY missions missions
COPY sitl sitl
COPY analysis analysis
COPY examples examples
# In place, as in a checkout: the demo finds the example beside the packages.
RUN pip install --no-deps --no-build-isolation --editable .

FROM python:3.11-slim
COPY --from=build /opt/vrspray /opt/vrspray
ENV PATH=/opt/vrspray/bin:$PATH PYTHONUNBUFFERED=1 MPLBACKEND=Agg
RUN useradd --create-home --uid 1000 vrspray \
 && ln -s /opt/vrspray/src/examples /home/vrspray/examples
USER vrspray
WORKDIR /home/vrspray
# SIGINT ends every command in order, valves closed; as process 1 the demo would ignore SIGTERM.
STOPSIGNAL SIGINT
ENTRYPOINT ["vrspray"]
CMD ["demo", "--out", "/home/vrspray/demo-out"]
