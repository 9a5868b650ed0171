# mereo on processors, with its shipped weights:
#   docker build -t mereo .
#   docker run --rm -v "$PWD:/data" --user "$(id -u):$(id -g)" mereo reconstruct frame.ply --weights bunny --output result

FROM python:3.13-slim AS build
WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
COPY weights weights
# torch without 3 GB of CUDA libraries; nothing is compiled, and no build tools are in the image
RUN python -m venv /opt/mereo && \
    /opt/mereo/bin/pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu \
        -c constraints.txt ./weights ".[network,cad,medical,sensors,serve]"

FROM python:3.13-slim
LABEL org.opencontainers.image.title="mereo" org.opencontainers.image.licenses="MIT"
COPY --from=build /opt/mereo /opt/mereo
ENV PATH=/opt/mereo/bin:$PATH OMP_WAIT_POLICY=passive HOME=/tmp
# fails here, and not at the first use, where a library of the system is missing
RUN mereo doctor && mereo scene check rope && useradd --create-home --uid 1000 mereo
USER 1000
WORKDIR /data
ENTRYPOINT ["mereo"]
CMD ["--help"]
