// Blocks of LANES pixels, and the splats that meet them, for kernels in which a work-item has a whole tile.
//
// A block is one vector, 4 pixels wide and LANES / 4 high. A splat visits only the blocks that its ellipse meets. They
// are found for a batch of splats before the first of them is composited, with splats as the lanes of vectors: for each
// row of blocks, the range of x that the ellipse spans (ellipse.h) yields the first and the last block, as bits.
//
// -DLANES=8|16   size of the device's vector registers: 16 floats if it has 512 bits, otherwise 8
#ifndef CLSPLAT_COMPOSITE_BLOCKS_H
#define CLSPLAT_COMPOSITE_BLOCKS_H

#if TILE != 8 && TILE != 16 && TILE != 32
#error "-DTILE must be 8, 16 or 32"
#endif
#if LANES != 8 && LANES != 16
#error "-DLANES must be 8 or 16, the pixels of a block"
#endif
#if TILE * TILE / LANES > 64
#error "-DTILE must be 8 or 16 with -DLANES=8: a set of blocks has 64 bits"
#endif
#define REALV   CONCATENATE(real, LANES)
#define MASKV   CONCATENATE(mask, LANES)
#define INTV    CONCATENATE(int, LANES)
#define TO_INTV CONCATENATE(TO_INT, LANES)
#ifdef USE_DOUBLE
#define MINUS_ABSOLUTE(x) LESSER(x, -(x))
#else
#define MINUS_ABSOLUTE(x) CONCATENATE(as_float, LANES)(CONCATENATE(as_uint, LANES)(x) | 0x80000000u)
#endif
#include "composite.h"
#include "power.h"

#define BLOCK_ROWS (LANES / 4)
#define COLUMNS    (TILE / 4)
#define ROWS       (TILE / BLOCK_ROWS)
#define BLOCKS     (ROWS * COLUMNS)

// Pixels of a block, in lanes: centres relative to its corner.
#if LANES == 16
#define PIXEL_X ((real16)(0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5))
#define PIXEL_Y ((real16)(0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5))
#else
#define PIXEL_X ((real8)(0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5))
#define PIXEL_Y ((real8)(0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5))
#endif

// A set of blocks: bit b is that of block b. In halves of 32 bits, a row of blocks lies within one.
typedef ulong Blocks;
#define HALVES ((BLOCKS + 31) / 32)

static inline real8 half_sums(REALV v) {
#if LANES == 16
    return v.lo + v.hi;
#else
    return v;
#endif
}

static inline real sum_lanes(REALV v) {
    const real8 a = half_sums(v);
    const real4 b = a.lo + a.hi;
    const real2 c = b.lo + b.hi;
    return c.x + c.y;
}

// The sums of a and b, in halves of four.
static inline real8 pair_sums(REALV a, REALV b) {
    const real8 x = half_sums(a), y = half_sums(b);
    return (real8)(x.lo, y.lo) + (real8)(x.hi, y.hi);
}

// Adds neighbours, and puts those of each half of y behind those of x.
static inline real8 neighbour_sums(real8 x, real8 y) {
    return (real8)(x.s02, y.s02, x.s46, y.s46) + (real8)(x.s13, y.s13, x.s57, y.s57);
}

// The sums over the lanes of eight vectors, by a tree that they share.
static inline real8 sum_lanes8(REALV v0, REALV v1, REALV v2, REALV v3, REALV v4, REALV v5, REALV v6, REALV v7) {
    const real8 v0415 = neighbour_sums(pair_sums(v0, v4), pair_sums(v1, v5));
    return neighbour_sums(v0415, neighbour_sums(pair_sums(v2, v6), pair_sums(v3, v7)));
}

static inline bool any_lane(MASKV mask) {
#if LANES == 16
    const mask8 m8 = mask.lo | mask.hi;
    const mask4 m4 = m8.lo | m8.hi;
#else
    const mask4 m4 = mask.lo | mask.hi;
#endif
    return m4.x | m4.y | m4.z | m4.w;
}

// Lane i of a vector in memory.
#define LANE(vector, i) (((const real *)&(vector))[i])

// Block and lane of pixel (x, y) of a tile.
static inline int block_of(int x, int y) {
    return y / BLOCK_ROWS * COLUMNS + x / 4;
}

static inline int lane_of(int x, int y) {
    return y % BLOCK_ROWS * 4 + x % 4;
}

// Corners of the blocks relative to the tile's, px.
typedef struct {
    real x[BLOCKS], y[BLOCKS];
#if RAYS == 2
    REALV rays[BLOCKS][3]; // directions of the pixels' rays
#endif
} Grid;

static inline Grid pixel_grid(void) {
    Grid grid;
    for (int b = 0; b < BLOCKS; ++b) {
        grid.x[b] = 4 * (b % COLUMNS);
        grid.y[b] = BLOCK_ROWS * (b / COLUMNS);
#if RAYS == 2
        // Pixels outside the image have no directions. Their gradients are 0 times what follows from these.
        for (int k = 0; k < 3; ++k)
            grid.rays[b][k] = 0;
#endif
    }
    return grid;
}

// Arguments of a kernel that reads the directions of the pixels' rays, and their loading.
#if RAYS == 2
#define DIRECTIONS , const __global real *directions
#define LOAD_DIRECTIONS(grid)                                                                                        \
    for (int r = 0; r < rows; ++r) {                                                                                 \
        for (int x = 0; x < columns; ++x) {                                                                          \
            const size_t p = (size_t)(y0 + r) * width + x0 + x;                                                      \
            for (int k = 0; k < 3; ++k)                                                                              \
                ((real *)&(grid).rays[block_of(x, r)][k])[lane_of(x, r)] = directions[3 * p + k];                    \
        }                                                                                                            \
    }
#else
#define DIRECTIONS
#define LOAD_DIRECTIONS(grid)
#endif

// The pixels of the tile's first block as seen from a splat, px.
typedef struct {
    REALV x, y;
} Corner;

static inline Corner corner_from(const Splat *s, int x0, int y0) {
#if RAYS == 2
    const Corner corner = {0, 0};
#else
    const Corner corner = {PIXEL_X + (x0 - s->x), PIXEL_Y + (y0 - s->y)};
#endif
    return corner;
}

static inline Offset offset_in(const Grid *grid, uint b, const Splat *s, Corner corner) {
#if RAYS == 2
    const REALV x = grid->rays[b][0], y = grid->rays[b][1], z = grid->rays[b][2];
    const Offset o = {s->axis0[0] * x + s->axis0[1] * y + s->axis0[2] * z,
                      s->axis1[0] * x + s->axis1[1] * y + s->axis1[2] * z,
                      s->axis2[0] * x + s->axis2[1] * y + s->axis2[2] * z};
#else
    Offset o;
    o.dx = corner.x + grid->x[b];
    o.dy = corner.y + grid->y[b];
#if RAYS
    o.along = 1;
#endif
#endif
    return o;
}

#define SQRTV(x) CONCATENATE(OF, LANES)(sqrt, x)
#if LANES == 16
DEFINE_POWER(16)
#define POWERV power16
#else
DEFINE_POWER(8)
#define POWERV power8
#endif

#include "composite_bands.h"

// Counting zeros in one instruction makes compositing a tenth faster. OpenCL C 1.2 has no function for it, and Oclgrind
// 21.10, which is based on Clang, cannot run the built-in (-DWITHOUT_CTZ).
static inline uint lowest_bit(ulong bits) {
#if defined(__clang__) && !defined(WITHOUT_CTZ)
    return __builtin_ctzl(bits);
#else
    return 63 - (uint)clz(bits & -bits);
#endif
}

// Removes the next block from a set that is not empty.
static inline uint take_block(Blocks *blocks) {
    const uint next = lowest_bit(*blocks);
    *blocks &= *blocks - 1;
    return next;
}

// The blocks with an unfinished pixel. The transmittances of neighbouring blocks are `stride` vectors apart.
static inline Blocks unfinished_blocks(const REALV *transmittance, uint stride) {
    Blocks blocks = 0;
    for (int b = 0; b < BLOCKS; ++b)
        blocks |= (Blocks)any_lane(transmittance[b * stride] > 0) << b;
    return blocks;
}

// Number of splats whose blocks are found before the first of them is composited. A processor cannot predict the end
// of the loop over blocks; if the bits are available early, it knows the end early. Finished blocks are searched
// between batches, which costs about as much as a few splats.
#define BATCH 64

// Splats, and the blocks of the tile that they meet.
typedef struct {
    Splat splats[BATCH];
    INTV halves[HALVES][BATCH / LANES];
} Batch;

static inline Blocks blocks_of(const Batch *batch, uint j) {
#if HALVES == 2
    return ((const uint *)batch->halves[0])[j] | (Blocks)((const uint *)batch->halves[1])[j] << 32;
#else
    return ((const uint *)batch->halves[0])[j];
#endif
}

// Outlines of a batch of splats (ellipse.h), with splats in lanes.
typedef struct {
    REALV x[BATCH / LANES], y[BATCH / LANES]; // centre, px
    REALV half_height[BATCH / LANES], at_right[BATCH / LANES];
#if RAYS
    REALV inv_half_height[BATCH / LANES], slope[BATCH / LANES], half_sq[BATCH / LANES];
#else
    REALV a[BATCH / LANES], b[BATCH / LANES], level[BATCH / LANES];
#endif
} Outlines;

static inline void set_outline(Outlines *outlines, uint j, const Splat *s) {
#if RAYS
    const Outline *e = &s->outline;
    ((real *)outlines->inv_half_height)[j] = e->inv_half_height;
    ((real *)outlines->slope)[j] = e->slope;
    ((real *)outlines->half_sq)[j] = e->half_sq;
#else
    const Splat *e = s;
    ((real *)outlines->a)[j] = s->a;
    ((real *)outlines->b)[j] = s->b;
    ((real *)outlines->level)[j] = s->level;
#endif
    ((real *)outlines->x)[j] = e->x;
    ((real *)outlines->y)[j] = e->y;
    ((real *)outlines->half_height)[j] = e->half_height;
    ((real *)outlines->at_right)[j] = e->at_right;
}

// Finds the blocks of the tile with corner (x0, y0) whose pixel centres the ellipses of LANES splats meet.
static inline void find_blocks(const Outlines *outlines, uint g, int x0, int y0, Batch *batch) {
    const REALV x = outlines->x[g] - (real)x0, y = outlines->y[g] - (real)y0;
#if RAYS
    const BandOutline outline = {x,
                                 y,
                                 outlines->half_height[g],
                                 outlines->inv_half_height[g],
                                 outlines->at_right[g],
                                 outlines->slope[g],
                                 outlines->half_sq[g]};
#else
    const BandOutline outline = band_outline(x, y, outlines->half_height[g], outlines->at_right[g], outlines->a[g],
                                             outlines->b[g], outlines->level[g]);
#endif
    INTV halves[HALVES];
    _Pragma("unroll") for (int h = 0; h < HALVES; ++h) halves[h] = 0;
    _Pragma("unroll") for (int r = 0; r < ROWS; ++r) {
        REALV begin, end;
        blocks_in_band(&outline, BLOCK_ROWS * r, BLOCK_ROWS * (r + 1) - 1, 4, COLUMNS, &begin, &end);
        const INTV bits = ((INTV)1 << TO_INTV(end)) - ((INTV)1 << TO_INTV(begin));
        halves[r * COLUMNS / 32] |= bits << (r * COLUMNS % 32);
    }
    _Pragma("unroll") for (int h = 0; h < HALVES; ++h) batch->halves[h][g] = halves[h];
}

// Prefetches the splat of entry i of a list that ends at `end`. Most splats span two cache lines. To be called between
// the splats of the batch before: of many requests at once, most would wait for others.
static inline void fetch_splat(const __global Splat *splats, const __global uint *gauss_ids, uint i, uint end) {
    if (i < end) {
        FETCH_TO_READ(&splats[gauss_ids[i]]);
        FETCH_TO_READ(&splats[gauss_ids[i]].color[CHANNELS - 1]);
    }
}

// Loads up to BATCH splats, beginning with the entry `first` of the list. Returns their number.
static inline uint load_batch(const __global Splat *splats, const __global uint *gauss_ids, uint first, uint end,
                              int x0, int y0, Batch *batch) {
    const uint count = LESSER((uint)BATCH, end - first);
    Outlines outlines;
    // All loads come first, so that cache misses overlap.
    for (uint j = 0; j < count; ++j) {
        batch->splats[j] = splats[gauss_ids[first + j]];
        set_outline(&outlines, j, &batch->splats[j]);
    }
    for (uint g = 0; g * LANES < count; ++g)
        find_blocks(&outlines, g, x0, y0, batch);
    return count;
}

// Transmittance 1 inside the image. Pixels outside count as finished.
static inline REALV transmittance_at_first(const Grid *grid, int b, int rows, int columns) {
    const MASKV inside = (PIXEL_X < (REALV)(columns - grid->x[b])) & (PIXEL_Y < (REALV)(rows - grid->y[b]));
    return inside ? (REALV)1 : (REALV)-1;
}

// The pixels of a block in the forward pass. What a visit of the block needs lies together, so that it takes one index.
typedef struct {
    REALV transmittance, color[CHANNELS];
} BlockPixels;

static inline BlockPixels pixels_at_first(const Grid *grid, int b, int rows, int columns) {
    BlockPixels pixels = {transmittance_at_first(grid, b, rows, columns), {0}};
    return pixels;
}

// Composites the entries [begin, end) of a tile's list over its blocks. A pixel is finished where the transmittance
// would fall to `stop` or below.
static inline void composite_tile(const Grid *grid, const __global Splat *splats, const __global uint *gauss_ids,
                                  uint begin, uint end, int x0, int y0, real stop, BlockPixels *pixels) {
    Batch batch;
    for (uint first = begin; first < end; first += BATCH) {
        const Blocks unfinished = unfinished_blocks(&pixels->transmittance, sizeof(BlockPixels) / sizeof(REALV));
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, x0, y0, &batch);
        for (uint j = 0; j < count; ++j) {
            fetch_splat(splats, gauss_ids, first + BATCH + j, end);
            const Splat *s = &batch.splats[j];
            const Corner corner = corner_from(s, x0, y0);
            for (Blocks blocks = unfinished & blocks_of(&batch, j); blocks;) {
                const uint b = take_block(&blocks);
                const Offset o = offset_in(grid, b, s, corner);
                Bend bend;
                const REALV t = splat_exponent(s, &o, &bend);
                REALV alpha = POWERV(t);
                MASKV live;
                const REALV weight = splat_over(splat_seen(s, t), stop, &alpha, &live, &pixels[b].transmittance);
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) pixels[b].color[k] += weight * s->color[k];
            }
        }
    }
}

#endif
