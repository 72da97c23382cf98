// Values of the -DLANES Gaussians that a work-item takes at once: 8 on CPUs, whose units work on vectors, else 1.
//
// `reals` holds one real number per Gaussian, and reals2 to reals4 hold the components of vectors. Arrays in memory
// hold Gaussians one after the other: chunks of LANES adjacent numbers are loaded, and rearranged by gathered2 to
// gathered4; scattered2 to scattered4 are the inverse. With one lane, chunks are values, and nothing is rearranged.
// `ints` holds one integer per Gaussian.
//
// The file that includes this documents -DLANES=1|8. Default: 1.
#ifndef CLSPLAT_LANES_H
#define CLSPLAT_LANES_H

#include "power.h"

#ifndef LANES
#define LANES 1
#endif
#if LANES != 1 && LANES != 8
#error "-DLANES must be 1 or 8"
#endif

#if LANES == 8
typedef real8 reals;
typedef mask8 masks; // results of comparisons of reals: all bits of a lane are set if it is true
typedef int8 ints;
#define OF_LANES(f, x) OF8(f, x)
#define ROOTS(x)       ROOT8(x)
#define TO_INTS(x)     TO_INT8(x) // of reals or masks
#define LANE_NUMBERS   ((reals)(0, 1, 2, 3, 4, 5, 6, 7))
DEFINE_POWER(8)
DEFINE_LOGARITHM(8)
#define POWER     power8
#define LOGARITHM logarithm8
#else
typedef real reals;
typedef int masks;
typedef int ints;
#define OF_LANES(f, x) f(x)
#define ROOTS(x)       ROOT(x)
#define TO_INTS(x)     ((int)(x))
#define LANE_NUMBERS   ((reals)0)
DEFINE_POWER()
#define POWER          power
#define LOGARITHM      logarithm
#endif

typedef struct {
    reals x, y;
} reals2;

typedef struct {
    reals x, y, z;
} reals3;

typedef struct {
    reals x, y, z, w;
} reals4;

#define LANE(v, lane)     (((const real *)&(v))[lane])
#define INT_LANE(v, lane) (((const int *)&(v))[lane])

static inline bool any_lane(masks m) {
#if LANES == 8
    const masks bits = m;
    return (bits.s0 | bits.s1 | bits.s2 | bits.s3 | bits.s4 | bits.s5 | bits.s6 | bits.s7) != 0;
#else
    return m != 0;
#endif
}

// Sum over the lanes.
static inline real lane_sum(reals v) {
#if LANES == 8
    return ((v.s0 + v.s1) + (v.s2 + v.s3)) + ((v.s4 + v.s5) + (v.s6 + v.s7));
#else
    return v;
#endif
}

// Prefetches the chunks of the work-item after the next one, of `count` chunks each. The arrays are more than a processor
// follows, and each of them is soon at the end of a page.
static inline void fetch_ahead(const __global real *x, int count) {
#if LANES == 8
#pragma unroll
    for (int k = 0; k < LANES * count; k += LINE)
        FETCH_TO_READ(x + 2 * LANES * count + k);
#endif
}

// Chunks of adjacent numbers from x[begin] on. Those from x[end] on are not read: they are 0.
static inline void load_chunks(const __global real *x, size_t begin, size_t end, int count, reals *chunks) {
#if LANES == 8
    if (begin + LANES * count <= end) {
        fetch_ahead(x + begin, count);
#pragma unroll
        for (int k = 0; k < count; ++k)
            chunks[k] = load8(x + begin + LANES * k);
        return;
    }
    for (int k = 0; k < LANES * count; ++k)
        ((real *)chunks)[k] = begin + k < end ? x[begin + k] : 0;
#else
    for (int k = 0; k < count; ++k)
        chunks[k] = begin + k < end ? x[begin + k] : 0;
#endif
}

// Stores chunks to x[begin] and the following. x[end] and what follows it are left as they are.
static inline void store_chunks(__global real *x, size_t begin, size_t end, int count, const reals *chunks) {
#if LANES == 8
    if (begin + LANES * count <= end) {
#pragma unroll
        for (int k = 0; k < count; ++k)
            store8(x + begin + LANES * k, chunks[k]);
        return;
    }
    for (int k = 0; k < LANES * count && begin + k < end; ++k)
        x[begin + k] = ((const real *)chunks)[k];
#else
    for (int k = 0; k < count && begin + k < end; ++k)
        x[begin + k] = chunks[k];
#endif
}

static inline reals2 gathered2(const reals *c) {
#if LANES == 8
    const reals2 v = {(reals)(c[0].even, c[1].even), (reals)(c[0].odd, c[1].odd)};
#else
    const reals2 v = {c[0], c[1]};
#endif
    return v;
}

static inline void scattered2(reals2 v, reals *c) {
#if LANES == 8
    c[0] = (reals)(v.x.s0, v.y.s0, v.x.s1, v.y.s1, v.x.s2, v.y.s2, v.x.s3, v.y.s3);
    c[1] = (reals)(v.x.s4, v.y.s4, v.x.s5, v.y.s5, v.x.s6, v.y.s6, v.x.s7, v.y.s7);
#else
    c[0] = v.x;
    c[1] = v.y;
#endif
}

static inline reals3 gathered3(const reals *c) {
#if LANES == 8
    const reals3 v = {(reals)(c[0].s036, c[1].s147, c[2].s25), (reals)(c[0].s147, c[1].s25, c[2].s036),
                      (reals)(c[0].s25, c[1].s036, c[2].s147)};
#else
    const reals3 v = {c[0], c[1], c[2]};
#endif
    return v;
}

static inline void scattered3(reals3 v, reals *c) {
#if LANES == 8
    c[0] = (reals)(v.x.s0, v.y.s0, v.z.s0, v.x.s1, v.y.s1, v.z.s1, v.x.s2, v.y.s2);
    c[1] = (reals)(v.z.s2, v.x.s3, v.y.s3, v.z.s3, v.x.s4, v.y.s4, v.z.s4, v.x.s5);
    c[2] = (reals)(v.y.s5, v.z.s5, v.x.s6, v.y.s6, v.z.s6, v.x.s7, v.y.s7, v.z.s7);
#else
    c[0] = v.x;
    c[1] = v.y;
    c[2] = v.z;
#endif
}

static inline reals4 gathered4(const reals *c) {
#if LANES == 8
    const reals4 v = {
        (reals)(c[0].s04, c[1].s04, c[2].s04, c[3].s04), (reals)(c[0].s15, c[1].s15, c[2].s15, c[3].s15),
        (reals)(c[0].s26, c[1].s26, c[2].s26, c[3].s26), (reals)(c[0].s37, c[1].s37, c[2].s37, c[3].s37)};
#else
    const reals4 v = {c[0], c[1], c[2], c[3]};
#endif
    return v;
}

static inline void scattered4(reals4 v, reals *c) {
#if LANES == 8
    c[0] = (reals)(v.x.s0, v.y.s0, v.z.s0, v.w.s0, v.x.s1, v.y.s1, v.z.s1, v.w.s1);
    c[1] = (reals)(v.x.s2, v.y.s2, v.z.s2, v.w.s2, v.x.s3, v.y.s3, v.z.s3, v.w.s3);
    c[2] = (reals)(v.x.s4, v.y.s4, v.z.s4, v.w.s4, v.x.s5, v.y.s5, v.z.s5, v.w.s5);
    c[3] = (reals)(v.x.s6, v.y.s6, v.z.s6, v.w.s6, v.x.s7, v.y.s7, v.z.s7, v.w.s7);
#else
    c[0] = v.x;
    c[1] = v.y;
    c[2] = v.z;
    c[3] = v.w;
#endif
}

// Transposes LANES chunks in place.
static inline void transpose(reals *c) {
#if LANES == 8
    reals a[8], b[8];
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        a[k] = (reals)(c[k].lo, c[k + 4].lo);
        a[k + 4] = (reals)(c[k].hi, c[k + 4].hi);
    }
#pragma unroll
    for (int j = 0; j < 4; ++j) {
        const int k = j < 2 ? j : j + 2;
        b[k] = (reals)(a[k].s01, a[k + 2].s01, a[k].s45, a[k + 2].s45);
        b[k + 2] = (reals)(a[k].s23, a[k + 2].s23, a[k].s67, a[k + 2].s67);
    }
#pragma unroll
    for (int k = 0; k < 8; k += 2) {
        c[k] = (reals)(b[k].s0, b[k + 1].s0, b[k].s2, b[k + 1].s2, b[k].s4, b[k + 1].s4, b[k].s6, b[k + 1].s6);
        c[k + 1] = (reals)(b[k].s1, b[k + 1].s1, b[k].s3, b[k + 1].s3, b[k].s5, b[k + 1].s5, b[k].s7, b[k + 1].s7);
    }
#endif
}

static inline reals load_numbers(const __global real *x, size_t i, size_t n) {
    reals v;
    load_chunks(x, i, n, 1, &v);
    return v;
}

static inline reals2 load_vectors2(const __global real *x, size_t i, size_t n) {
    reals c[2];
    load_chunks(x, 2 * i, 2 * n, 2, c);
    return gathered2(c);
}

static inline reals3 load_vectors3(const __global real *x, size_t i, size_t n) {
    reals c[3];
    load_chunks(x, 3 * i, 3 * n, 3, c);
    return gathered3(c);
}

static inline reals4 load_vectors4(const __global real *x, size_t i, size_t n) {
    reals c[4];
    load_chunks(x, 4 * i, 4 * n, 4, c);
    return gathered4(c);
}

static inline void store_numbers(__global real *x, size_t i, size_t n, reals v) {
    store_chunks(x, i, n, 1, &v);
}

static inline void store_vectors2(__global real *x, size_t i, size_t n, reals2 v) {
    reals c[2];
    scattered2(v, c);
    store_chunks(x, 2 * i, 2 * n, 2, c);
}

static inline void store_vectors3(__global real *x, size_t i, size_t n, reals3 v) {
    reals c[3];
    scattered3(v, c);
    store_chunks(x, 3 * i, 3 * n, 3, c);
}

static inline void store_vectors4(__global real *x, size_t i, size_t n, reals4 v) {
    reals c[4];
    scattered4(v, c);
    store_chunks(x, 4 * i, 4 * n, 4, c);
}

#endif
