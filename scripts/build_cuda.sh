#!/bin/sh
# Builds noctule with feature `cuda` on a machine that has neither a GPU nor a CUDA toolkit: the
# toolkit's parts come from the Python package index. The binary needs the CUDA 13 runtime libraries
# and an NVIDIA driver where it runs (README, "GPU").
#
#   scripts/build_cuda.sh [CARGO ARGUMENTS]     e.g. scripts/build_cuda.sh --features cudnn
#
# NOCTULE_CUDA_DIR      where the toolkit is put together (default target/cuda; 1 GB, with cuDNN 1.6)
# CUDA_COMPUTE_CAP      the GPU's compute capability without its dot (default 90, Hopper)
set -eu

here=$(cd "$(dirname "$0")/.." && pwd)
dir=${NOCTULE_CUDA_DIR:-$here/target/cuda}
toolkit=$dir/toolkit
mkdir -p "$dir"

say() { printf '%s\n' "build_cuda: $*" >&2; }
for tool in python3 cc cargo; do
    command -v "$tool" >/dev/null || { say "needs $tool"; exit 1; }
done

# Versions that fit one another and a driver of the 580 series or later.
packages="nvidia-cuda-nvcc==13.0.88 nvidia-cuda-crt==13.0.88 nvidia-nvvm==13.0.88
    nvidia-cuda-runtime==13.0.96 nvidia-cuda-cccl==13.0.85 nvidia-cuda-nvrtc==13.0.88
    nvidia-curand==10.4.0.35 nvidia-cublas==13.1.0.3"
case " $* " in
*cudnn*) packages="$packages nvidia-cudnn-cu13==9.15.1.9" ;;
esac

parts=$dir/parts
stamp=$dir/parts.txt
if [ "$(cat "$stamp" 2>/dev/null || true)" != "$packages" ]; then
    say "fetching the toolkit's parts into $parts"
    rm -rf "$parts" "$toolkit"
    # shellcheck disable=SC2086 # a list of packages
    python3 -m pip install --quiet --no-deps --target "$parts" $packages
    printf '%s' "$packages" >"$stamp"
fi

if [ ! -e "$toolkit/lib64/stubs/libcuda.so" ]; then
    say "putting the toolkit together in $toolkit"
    rm -rf "$toolkit"
    mkdir -p "$toolkit/lib64/stubs"
    # Copies, not links: nvcc finds the rest of the toolkit from its own path.
    for part in bin include nvvm; do
        cp -R "$parts/nvidia/cu13/$part" "$toolkit/$part"
    done
    chmod +x "$toolkit"/bin/* "$toolkit"/nvvm/bin/* 2>/dev/null || true
    for library in "$parts"/nvidia/cu13/lib/lib*.so.* "$parts"/nvidia/cudnn/lib/lib*.so.*; do
        [ -e "$library" ] || continue
        name=$(basename "$library")
        ln -sf "$library" "$toolkit/lib64/$name"
        ln -sf "$name" "$toolkit/lib64/${name%%.so.*}.so"
    done
    cp "$parts"/nvidia/cu13/lib/libcudart_static.a "$parts"/nvidia/cu13/lib/libcudadevrt.a \
        "$toolkit/lib64/"
    # The driver's library comes with the driver. To link against, and to start without a GPU, this
    # one answers every call with CUDA_ERROR_NO_DEVICE (100).
    (cd "$here" && cargo fetch --quiet)
    bindings=$(find "${CARGO_HOME:-$HOME/.cargo}/registry/src" \
        -path '*/cudarc-*/src/driver/sys/mod.rs' | sort | tail -n 1)
    [ -n "$bindings" ] || { say "cudarc's sources are not in the cargo registry"; exit 1; }
    grep -oE '\bfn cu[A-Z][A-Za-z0-9_]*' "$bindings" | sed 's/fn //' | sort -u |
        sed 's/.*/int &(void) { return 100; }/' >"$dir/cuda_stub.c"
    cc -shared -fPIC -O1 -Wl,-soname,libcuda.so.1 -o "$toolkit/lib64/stubs/libcuda.so.1" \
        "$dir/cuda_stub.c"
    ln -sf libcuda.so.1 "$toolkit/lib64/stubs/libcuda.so"
fi

export CUDA_HOME="$toolkit" CUDA_PATH="$toolkit"
export PATH="$toolkit/bin:$PATH"
export CUDA_COMPUTE_CAP="${CUDA_COMPUTE_CAP:-90}"
export NVCC_APPEND_FLAGS="-I $toolkit/include/cccl"
export LIBRARY_PATH="$toolkit/lib64:$toolkit/lib64/stubs"
cd "$here"
say "building (a quarter of an hour of processor time when the kernels are not built yet)"
cargo build --release --features cuda --target-dir "$dir/target" "$@"
say "built $dir/target/release/noctule"
say "try it here: LD_LIBRARY_PATH=$toolkit/lib64:$toolkit/lib64/stubs $dir/target/release/noctule --help"
