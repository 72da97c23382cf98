// Micro-benchmarks of `clsplat bench kernels` that measure the limits of the device. This is not a stage.
//
//   roof_fma, roof_exp, roof_exp2   arithmetic on CHAINS independent values per work-item
//   roof_copy, roof_triad           y = a; y = a + factor b
//   roof_empty                      no work, to measure the launch
//
// Mapping: a work-item keeps its values in registers for `rounds` rounds, or moves the `count` vectors first,
// first + step, ... of the buffers. On a CPU these are adjacent; on a GPU, adjacent work-items have adjacent vectors.
// The recurrences converge to a number of the order of 1 from any start, and their results are stored. So a compiler
// cannot remove the work, and there are no infinities or denormal numbers.
// Without the pragma to unroll, PoCL keeps the values in memory, at a quarter of the speed.
//
// Buffers: out[items,WIDTH]; a, b, y[items count,WIDTH]
// -DWIDTH=1|4|16   width of the vectors
// -DHALVES=0|1     1: vectors of 16 go through exp and exp2 in halves
#include "common.h"

#if WIDTH == 1
#define REALV          real
#define LOAD(i, p)     ((p)[i])
#define STORE(v, i, p) ((p)[i] = (v))
#elif WIDTH == 4
#define REALV CONCATENATE(real, WIDTH)
#define LOAD  CONCATENATE(vload, WIDTH)
#define STORE CONCATENATE(vstore, WIDTH)
#elif WIDTH == 16
#define REALV          real16
#define LOAD(i, p)     load16((p) + 16 * (i))
#define STORE(v, i, p) store16((p) + 16 * (i), v)
#else
#error "-DWIDTH must be 1, 4 or 16"
#endif

#if !defined(HALVES) || HALVES & ~1
#error "-DHALVES must be 0 or 1"
#elif HALVES
#define FUNCTION(f, x) OF16(f, x)
#else
#define FUNCTION(f, x) f(x)
#endif

// Two multiply-adds per cycle with a latency of four cycles need at least eight values. PoCL's exp gains up to 12.
#define CHAINS 16

static inline void start(REALV *x) {
    for (int k = 0; k < CHAINS; ++k)
        x[k] = (REALV)(k + (real)get_global_id(0));
}

static inline void finish(const REALV *x, __global real *out) {
    REALV sum = 0;
    for (int k = 0; k < CHAINS; ++k)
        sum += x[k];
    STORE(sum, get_global_id(0), out);
}

__kernel void roof_fma(const uint rounds, const real factor, const real summand, __global real *out) {
    REALV x[CHAINS];
    start(x);
    for (uint i = 0; i < rounds; ++i)
#pragma unroll
        for (int k = 0; k < CHAINS; ++k)
            x[k] = x[k] * factor + summand; // contracted; PoCL's fma() and mad() are ten times slower
    finish(x, out);
}

__kernel void roof_exp(const uint rounds, __global real *out) {
    REALV x[CHAINS];
    start(x);
    for (uint i = 0; i < rounds; ++i)
#pragma unroll
        for (int k = 0; k < CHAINS; ++k)
            x[k] = FUNCTION(exp, -x[k]);
    finish(x, out);
}

__kernel void roof_exp2(const uint rounds, __global real *out) {
    REALV x[CHAINS];
    start(x);
    for (uint i = 0; i < rounds; ++i)
#pragma unroll
        for (int k = 0; k < CHAINS; ++k)
            x[k] = FUNCTION(exp2, -x[k]);
    finish(x, out);
}

// Index of a work-item's first vector.
static inline size_t first_vector(uint count, uint step) {
    return step == 1 ? (size_t)get_global_id(0) * count : get_global_id(0);
}

__kernel void roof_copy(const uint count, const uint step, const __global real *a, __global real *y) {
    size_t i = first_vector(count, step);
    for (uint k = 0; k < count; ++k, i += step)
        STORE(LOAD(i, a), i, y);
}

__kernel void roof_triad(const uint count, const uint step, const real factor, const __global real *a,
                         const __global real *b, __global real *y) {
    size_t i = first_vector(count, step);
    for (uint k = 0; k < count; ++k, i += step)
        STORE(LOAD(i, a) + factor * LOAD(i, b), i, y);
}

__kernel void roof_empty(__global real *out) {
}
