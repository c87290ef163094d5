# Untested: nobody has built this yet.
#   docker build -t orthoflow . && docker run --rm -v "$PWD:/data" orthoflow run quickstart.yaml
FROM python:3.12-slim
COPY . /source
RUN pip install --no-cache-dir /source && rm -r /source
WORKDIR /data
ENTRYPOINT ["orthoflow"]
