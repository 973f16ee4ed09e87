# docker build --target cpu --tag shellgs:cpu .     any machine
# docker build --tag shellgs .                      for NVIDIA GPUs: gsplat's kernels are compiled here, not in the first run
# docker run --rm --volume "$PWD:/work" shellgs:cpu demo

FROM python:3.11-slim-bookworm AS cpu
# Without CUDA's libraries: the words of PyTorch's guide for Linux, pip, CPU.
ARG TORCH="torch torchvision"
COPY . /opt/shellgs
WORKDIR /opt/shellgs
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ libegl1 libgl1 libgomp1 libidn2-0 libudev1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir ${TORCH} \
    && pip install --no-cache-dir ".[sim,las,e57,bim]" \
    && shellgs doctor
WORKDIR /work
ENTRYPOINT ["shellgs"]

FROM pytorch/pytorch:2.8.0-cuda12.8-cudnn9-devel AS cuda
ENV TORCH_CUDA_ARCH_LIST="7.5;8.0;8.6;8.9;9.0" TORCH_EXTENSIONS_DIR=/opt/kernels
COPY . /opt/shellgs
WORKDIR /opt/shellgs
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ libegl1 libgl1 libgomp1 libidn2-0 libudev1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir ninja ".[sim,las,e57,bim]" \
    && pip install --no-cache-dir --no-deps gsplat==1.5.3 \
    && python -c "from gsplat.cuda._backend import _C; assert _C is not None"
WORKDIR /work
ENTRYPOINT ["shellgs"]
