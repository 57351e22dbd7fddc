# The package without its extras, for `docker run --rm -v "$PWD:/work" finssim demo`. It has not been built here: no engine was at hand.
FROM python:3.11-slim
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE NOTICE ./
COPY src src
RUN pip install --no-cache-dir --constraint constraints.txt .
WORKDIR /work
ENTRYPOINT ["finssim"]
CMD ["--help"]
