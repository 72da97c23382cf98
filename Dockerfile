# clsplat with OpenCL on the CPU (PoCL) and, where the container gets a GPU of NVIDIA, on that.
#
#   docker build -t clsplat .
#   docker run --rm -v "$PWD":/data clsplat train photos -o scene
#   docker run --rm --gpus all -v "$PWD":/data clsplat train photos -o scene
#   docker run --rm -p 8080:8080 -v "$PWD":/data clsplat view scene/scene.ply --host 0.0.0.0
FROM python:3.12-slim

COPY . /src
RUN pip install --no-cache-dir '/src[pocl,viewer,video,flip,heic]' && rm -rf /src

# One folder names all drivers: PoCL's from its wheel, and NVIDIA's, whose library comes from the host
# (nvidia-container-toolkit). A driver whose library is missing is left out.
RUN mkdir -p /etc/OpenCL/vendors && echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd && \
    python -c "import pyopencl, shutil; shutil.copy(pyopencl.__path__[0] + '/.libs/pocl.icd', '/etc/OpenCL/vendors')"
ENV OCL_ICD_VENDORS=/etc/OpenCL/vendors NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility

WORKDIR /data
ENTRYPOINT ["clsplat"]
