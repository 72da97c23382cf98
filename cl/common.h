// Real type, literals and index helpers shared by every stage.
//
// -DUSE_DOUBLE  selects real = double. Without it, real is float, and the host passes -cl-single-precision-constant, so
//               that unsuffixed literals have the type real in both builds.
// -DALPHA_MIN, LOG2_ALPHA_MIN, EXPONENT_SLACK, ALPHA_MAX, TRANSMITTANCE_MIN, BLUR, COMPENSATION_MIN, NEAR, FRUSTUM_MARGIN,
// -DQUAT_NORM2_MIN, EXTENT_SLACK
//               constants of the model; clsplat/constants.py defines them, with reasons and sources.
//
// Functions are `static inline`: a plain `inline` of C99 defines no external function, and linking fails if the
// compiler does not inline it, as some drivers do without optimisation.
#ifndef CLSPLAT_COMMON_H
#define CLSPLAT_COMMON_H

#if !defined(ALPHA_MIN) || !defined(LOG2_ALPHA_MIN) || !defined(EXPONENT_SLACK) || !defined(ALPHA_MAX) ||            \
    !defined(TRANSMITTANCE_MIN) || !defined(BLUR) || !defined(COMPENSATION_MIN) || !defined(NEAR) ||                 \
    !defined(QUAT_NORM2_MIN) || !defined(EXTENT_SLACK) || !defined(FRUSTUM_MARGIN)
#error "the constants of clsplat/constants.py must be passed as -D; build through clsplat.device.Device.program"
#endif

#ifdef USE_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
typedef double2 real2;
typedef double3 real3;
typedef double4 real4;
typedef double8 real8;
typedef double16 real16;
typedef long4 mask4; // result of comparing two real4
typedef long8 mask8;
typedef long16 mask16;
#define EPSILON DBL_EPSILON
#else
typedef float real;
typedef float2 real2;
typedef float3 real3;
typedef float4 real4;
typedef float8 real8;
typedef float16 real16;
typedef int4 mask4;
typedef int8 mask8;
typedef int16 mask16;
#define EPSILON FLT_EPSILON
#endif

// For functions that a compiler would call: arguments would pass through memory, and loops would have no constant ends.
#ifndef INLINED // `make check-races` defines it without inlining (tests/check_races.py)
#define INLINED static inline __attribute__((always_inline))
#endif

#define CONCATENATE_(a, b) a##b
#define CONCATENATE(a, b)  CONCATENATE_(a, b)

// For innermost loops; for vectors and scalars. PoCL inlines built-in functions only if its library was compiled for
// features of the detected CPU. Otherwise each use is a call, which spills all vector registers.
#define LESSER(a, b)     ((a) < (b) ? (a) : (b))
#define GREATER(a, b)    ((a) > (b) ? (a) : (b))
#define CLAMP(x, lo, hi) ((x) < (lo) ? (lo) : (x) > (hi) ? (hi) : (x))
#define ABSOLUTE(x)      ((x) < 0 ? -(x) : (x))

// Whether a number is neither infinite nor NaN, or of a vector, which are. Not 0 * x == 0: Mesa takes 0 * x for 0.
#ifdef USE_DOUBLE
#define FINITE(x) (ABSOLUTE(x) <= DBL_MAX)
#else
#define FINITE(x) (ABSOLUTE(x) <= FLT_MAX)
#endif

// A function of the driver on 4, 8 or 16 values, called with at most 256 bits at once. PoCL 3.0 compiles for Zen 4,
// which has AVX-512, as for a CPU without it, but calls functions that were built for AVX-512. With wider arguments
// its compiler crashes, hangs or generates wrong code. vload16 and conversions are such functions, too.
#define IN_HALVES(type, f, x) ((type)(f((x).lo), f((x).hi)))
#define OF(f, x)              f(x)
#define OF4(f, x)             f(x)
#ifdef USE_DOUBLE
#define OF8(f, x)  IN_HALVES(real8, f, x)
#define OF16(f, x) ((real16)(f((x).lo.lo), f((x).lo.hi), f((x).hi.lo), f((x).hi.hi)))
#define TO_INT8(x) IN_HALVES(int8, convert_int4, x)
#else
#define OF8(f, x)  f(x)
#define OF16(f, x) IN_HALVES(real16, f, x)
#define TO_INT8(x) convert_int8(x)
#endif
#define TO_INT4(x)  convert_int4(x)
#define TO_INT16(x) ((int16)(TO_INT8((x).lo), TO_INT8((x).hi)))

// Square roots and fused multiply-adds of 8 reals. A call of PoCL's functions would spill all vector registers, so that
// instructions are named where there are any; both results are correctly rounded, as those of the functions.
#if !defined(USE_DOUBLE) && defined(__clang__) && defined(__AVX__) && defined(__FMA__)
// Compilers drop such built-in functions when they find general ones for them.
#define NAMED_INSTRUCTIONS (__has_builtin(__builtin_ia32_sqrtps256) && __has_builtin(__builtin_ia32_vfmaddps256))
#else
#define NAMED_INSTRUCTIONS 0
#endif
#if NAMED_INSTRUCTIONS
typedef float Lanes8 __attribute__((vector_size(32))); // built-in functions of Clang take no float8
#define AS_LANES8(x)  __builtin_astype(x, Lanes8)
#define ROOT8(x)      __builtin_astype(__builtin_ia32_sqrtps256(AS_LANES8(x)), real8)
#define FMA8(a, b, c) __builtin_astype(__builtin_ia32_vfmaddps256(AS_LANES8(a), AS_LANES8(b), AS_LANES8(c)), real8)
#else
#define ROOT8(x) OF8(sqrt, x)
#ifdef USE_DOUBLE
#define FMA8(a, b, c) ((real8)(fma((a).lo, (b).lo, (c).lo), fma((a).hi, (b).hi, (c).hi)))
#else
#define FMA8(a, b, c) fma(a, b, c)
#endif
#endif
#define ROOT(x)   sqrt(x)
#define ROOT16(x) ((real16)(ROOT8((x).lo), ROOT8((x).hi)))

// Reals of a cache line, which come at once.
#define LINE ((int)(64 / sizeof(real)))

// Prefetches memory to read or to write, where a processor does not foresee the addresses. Only for kernels on the
// host's processor, where addresses are ordinary pointers.
#if defined(__clang__) && (defined(__x86_64__) || defined(__aarch64__))
#define FETCH_TO_READ(p)  __builtin_prefetch((const void *)(size_t)(p))
#define FETCH_TO_WRITE(p) __builtin_prefetch((const void *)(size_t)(p), 1)
#else
#define FETCH_TO_READ(p)  ((void)(p))
#define FETCH_TO_WRITE(p) ((void)(p))
#endif

static inline real2 load2(const __global real *x, size_t i) {
    return (real2)(x[2 * i], x[2 * i + 1]);
}

static inline void store2(__global real *x, size_t i, real2 value) {
    x[2 * i] = value.x;
    x[2 * i + 1] = value.y;
}

static inline real3 load3(const __global real *x, size_t i) {
    return (real3)(x[3 * i], x[3 * i + 1], x[3 * i + 2]);
}

static inline void store3(__global real *x, size_t i, real3 value) {
    x[3 * i] = value.x;
    x[3 * i + 1] = value.y;
    x[3 * i + 2] = value.z;
}

static inline real4 load4(const __global real *x, size_t i) {
    return (real4)(x[4 * i], x[4 * i + 1], x[4 * i + 2], x[4 * i + 3]);
}

static inline void store4(__global real *x, size_t i, real4 value) {
    x[4 * i] = value.x;
    x[4 * i + 1] = value.y;
    x[4 * i + 2] = value.z;
    x[4 * i + 3] = value.w;
}

// 8 or 16 adjacent values at any address.
#define DEFINE_ACCESS(N)                                                                                             \
    typedef struct __attribute__((packed)) {                                                                         \
        real##N v;                                                                                                   \
    } Packed##N;                                                                                                     \
    static inline real##N load##N(const __global real *x) {                                                          \
        return ((const __global Packed##N *)x)->v;                                                                   \
    }                                                                                                                \
    static inline void store##N(__global real *x, real##N value) {                                                   \
        ((__global Packed##N *)x)->v = value;                                                                        \
    }
DEFINE_ACCESS(8)
DEFINE_ACCESS(16)

#endif
