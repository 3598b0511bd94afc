# docker build -t list3r . && docker run --rm -v "$PWD:/data" list3r build walk.mp4 -m house.l3r
FROM python:3.12-slim
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
# An index with CPU builds of PyTorch, by --build-arg TORCH_INDEX=URL; without one pip brings the builds for CUDA, several GB.
ARG TORCH_INDEX=""
# hadolint ignore=DL3013
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch
COPY . /src
RUN pip install --no-cache-dir '/src[all,view,mcp]' && rm -rf /src
RUN useradd --create-home --uid 1000 list3r
USER 1000
WORKDIR /data
ENTRYPOINT ["list3r"]
CMD ["--help"]
