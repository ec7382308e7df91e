# The command fgloc with the tested versions of its dependencies, which are those of Debian 12's Python 3.11.
#
#     docker build -t fgloc .
#     docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/logs" fgloc compare plaza2 -e ekf,smoother -o out
FROM debian:12-slim

RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN python3 -m venv /opt/fgloc \
    && /opt/fgloc/bin/pip install --no-cache-dir --disable-pip-version-check -c /src/constraints.txt '/src[ros]' \
    && rm -rf /src \
    && ln -s /opt/fgloc/bin/fgloc /usr/local/bin/fgloc \
    && fgloc --version

# whoever runs it: what numba compiles and matplotlib looks up is kept there
ENV HOME=/tmp
USER 1000:1000
WORKDIR /logs
ENTRYPOINT ["fgloc"]
