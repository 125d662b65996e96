# docker build -t virest .
# docker run --rm -v "$PWD:/data" virest process /data/walk --out /data/out
FROM python:3.11-slim
WORKDIR /opt/virest
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY virest virest
RUN pip install --no-cache-dir --constraint constraints.txt '.[cluster,telemetry,rosbags]' && rm -rf /opt/virest/*
# the linear algebra of each worker stays on its own core
ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /data
ENTRYPOINT ["virest"]
CMD ["--help"]
