# labpipe in a container. In a checkout of this repository:
#
#   docker build -t labpipe .
#   mkdir -p out && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD/out:/bench/out" labpipe
#
# runs the main job on the shipped sample data and leaves the report in out/pedestal/report.html. With other words behind it the container
# is the command itself, with a folder of yours as /bench:
#
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/bench" labpipe run my-rig/pipeline.yaml -o my-rig/out
FROM python:3.13-slim AS build
COPY pyproject.toml README.md /source/
COPY labpipe /source/labpipe
COPY pipelines /source/pipelines
COPY configs /source/configs
COPY sample_data /source/sample_data
RUN python -m venv /opt/labpipe && /opt/labpipe/bin/pip install --no-cache-dir /source

FROM python:3.13-slim
COPY --from=build /opt/labpipe /opt/labpipe
ENV PATH="/opt/labpipe/bin:$PATH" MPLCONFIGDIR=/tmp/matplotlib PYTHONUNBUFFERED=1
# It may be run as another user, by --user: the results belong to whoever called for them, and the mounted folder need not be open to all.
RUN useradd --create-home --uid 1000 labpipe && mkdir -p /bench/out && chown -R labpipe:labpipe /bench && chmod 1777 /bench /bench/out
USER labpipe
WORKDIR /bench
COPY pipelines /bench/pipelines
COPY configs /bench/configs
COPY sample_data /bench/sample_data
VOLUME /bench/out
ENTRYPOINT ["labpipe"]
CMD ["run", "pipelines/pedestal.yaml", "-o", "out/pedestal"]
