# One image for all programs. rotortrain (training, commissioning) needs the extra "train", which is not in it.
FROM python:3.11.13-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
# Dependencies first, so that a change of the source does not fetch them again.
COPY constraints.txt pyproject.toml README.md LICENSE ./
RUN python -m venv /opt/venv \
    && mkdir models rotorwatch service simulator \
    && touch models/__init__.py service/__init__.py simulator/__init__.py \
    && echo '__version__ = "0"' > rotorwatch/__init__.py \
    && /opt/venv/bin/pip install --constraint constraints.txt . \
    && /opt/venv/bin/pip uninstall --yes rotorwatch \
    && rm -r build  # or what is older than it would be taken from there
COPY models models
COPY rotorwatch rotorwatch
COPY service service
COPY simulator simulator
RUN /opt/venv/bin/pip install --constraint constraints.txt --no-deps .

FROM python:3.11.13-slim-bookworm
ENV PATH=/opt/venv/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
RUN useradd --system --uid 10001 --no-create-home --shell /usr/sbin/nologin rotorwatch
# A volume that is mounted here belongs to whoever owns the folder.
RUN install -d -o 10001 -g 10001 -m 0700 /var/lib/rotorwatch
COPY --from=build /opt/venv /opt/venv
COPY deploy/healthcheck.py /opt/healthcheck.py
USER 10001:10001
WORKDIR /
CMD ["rotorwatch", "--help"]
