# The image of lumidock for vehicles, amd64 and arm64; its labels make it an extension of BlueOS. See docs/container.md.
ARG PYTHON=3.11

FROM python:${PYTHON}-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/lumidock
COPY requirements.lock /source/
# every version as locked; pip takes hashes from a list of requirements only, which a folder to install cannot be on
RUN sed -e '/^[ #]/d' -e 's/ *\\$//' /source/requirements.lock > /source/constraints.txt
COPY pyproject.toml README.md LICENSE /source/
COPY src /source/src
RUN /opt/lumidock/bin/pip install --constraint /source/constraints.txt '/source[bag,console,live,mavlink,video,zenoh]'

FROM python:${PYTHON}-slim-bookworm
COPY --from=build /opt/lumidock /opt/lumidock
# kernels are compiled here, for any processor of the architecture, and found again where the image runs
ENV PATH=/opt/lumidock/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin NUMBA_CPU_NAME=generic NUMBA_CACHE_DIR=/var/cache/lumidock HOME=/data
RUN groupadd --gid 10001 lumidock \
 && useradd --uid 10001 --gid 10001 --home-dir /data --no-create-home --shell /usr/sbin/nologin lumidock \
 && install --directory --owner 10001 --group 10001 /data /var/cache/lumidock
USER lumidock
RUN lumidock warm
WORKDIR /data
VOLUME /data
EXPOSE 8780/tcp
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s --retries=3 \
  CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8780/health.json', timeout=4)"]
ENTRYPOINT ["lumidock"]
CMD ["serve", "rtsp://127.0.0.1:8554/dock", "--station", "dock.yaml", "--camera", "camera.yaml", "--host", "0.0.0.0", "--console"]

ARG VERSION=0.1.0
ARG AUTHOR="The lumidock authors"
ARG EMAIL=""
ARG SOURCE=""
LABEL version="${VERSION}"
LABEL permissions='{"ExposedPorts": {"8780/tcp": {}}, "HostConfig": {"NetworkMode": "host", "Binds": ["/usr/blueos/extensions/lumidock:/data"]}}'
LABEL authors="[{\"name\": \"${AUTHOR}\", \"email\": \"${EMAIL}\"}]"
LABEL company="{\"about\": \"Pose of a vehicle relative to its dock\", \"name\": \"${AUTHOR}\", \"email\": \"${EMAIL}\"}"
LABEL readme="${SOURCE}/README.md"
LABEL links="{\"source\": \"${SOURCE}\"}"
LABEL type="device-integration"
LABEL tags='["navigation", "docking", "camera", "positioning"]'
LABEL requirements="core >= 1.1"
