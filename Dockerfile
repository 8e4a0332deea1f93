# docker build -t sfm-audit .   then   docker run --rm -v "$PWD:/data" -u "$(id -u)" sfm-audit run model -o RUN
# scripts/lint lints this file, and tests/e2e/test_ci_recipes.py runs its steps.
# not slim: it has the C compiler that compiled kernels are built with, which the image below does not need
FROM python:3.13 AS build
WORKDIR /src
COPY . .
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:3.13-slim
COPY --from=build /wheel /wheel
RUN python -m pip install --no-cache-dir "$(echo /wheel/*.whl)[report]" && rm -r /wheel
# nobody: files of the host are written as the user that docker run -u names
USER 65534
ENV MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /data
ENTRYPOINT ["sfm-audit"]
CMD ["--help"]
