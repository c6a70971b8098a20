# The README's two commands in a container, without a GPU:
#   docker build -t coopoc . && docker run --name coopoc coopoc make paper && docker cp coopoc:/home/coopoc/clone/runs .
# The base is python:3.13-slim-bookworm of Docker's library, by its mirror, which has no limit of pulls.
FROM public.ecr.aws/docker/library/python:3.13-slim-bookworm@sha256:01f42367a0a94ad4bc17111776fd66e3500c1d87c15bbd6055b7371d39c124fb AS tools
# Chromium, LaTeX and pdftoppm: without them tests of reports and tables skip. Debian keeps one version of each in a release.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends chromium git poppler-utils texlive-latex-base texlive-latex-recommended make \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 1000 --create-home coopoc \
    && install -d -o coopoc -g coopoc /home/coopoc/clone
USER 1000
# The folder is not called coopoc: above such a folder, Python takes it for the package.
WORKDIR /home/coopoc/clone
ENV TORCH_INDEX=https://download.pytorch.org/whl/cpu

FROM tools AS ready
COPY --chown=coopoc:coopoc . .
RUN make .venv/.ready-dev
CMD ["make", "test"]
