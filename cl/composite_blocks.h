// Blocks of LANES pixels, and the splats that meet them, for kernels in which a work-item has a whole tile.
//
// A block is one vector, 4 pixels wide and LANES / 4 high. A splat visits only the blocks that its ellipse meets. To
// find them, a second vector has the rows of blocks as its lanes: one evaluation yields the range of x that the
// ellipse spans in each row (ellipse.h), and comparisons with the columns of blocks yield a set of bits.
//
// -DLANES=8|16   size of the device's vector registers: 16 floats if it has 512 bits, otherwise 8
#ifndef CLSPLAT_COMPOSITE_BLOCKS_H
#define CLSPLAT_COMPOSITE_BLOCKS_H

#if TILE != 8 && TILE != 16
#error "-DTILE must be 8 or 16: rows of blocks are the lanes of a vector"
#endif
#if LANES != 8 && LANES != 16
#error "-DLANES must be 8 or 16, the pixels of a block"
#endif
#define REALV CONCATENATE(real, LANES)
#define MASKV CONCATENATE(mask, LANES)
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

// Rows of blocks, in lanes: their numbers, and the bit of the first block of each (0 if the tile has no such row).
#if ROWS == 8
#define ROWV      real8
#define MASKR     mask8
#define OF_ROWS   OF8
#define ROW       ((real8)(0, 1, 2, 3, 4, 5, 6, 7))
#define FIRST_BIT ((mask8)(1, 1 << 4, 1 << 8, 1 << 12, 1 << 16, 1 << 20, 1 << 24, 1 << 28))
#else
#define ROWV    real4
#define MASKR   mask4
#define OF_ROWS OF4
#define ROW     ((real4)(0, 1, 2, 3))
#if TILE == 16
#define FIRST_BIT ((mask4)(1, 1 << 4, 1 << 8, 1 << 12))
#elif ROWS == 4
#define FIRST_BIT ((mask4)(1, 1 << 2, 1 << 4, 1 << 6))
#else
#define FIRST_BIT ((mask4)(1, 1 << 2, 0, 0))
#endif
#endif

static inline real4 quarters(REALV v) {
#if LANES == 16
    const real8 half_sums = v.lo + v.hi;
    return half_sums.lo + half_sums.hi;
#else
    return v.lo + v.hi;
#endif
}

static inline real sum_lanes(REALV v) {
    const real4 a = quarters(v);
    const real2 b = a.lo + a.hi;
    return b.x + b.y;
}

static inline real4 sum_lanes4(REALV v0, REALV v1, REALV v2, REALV v3) {
    const real4 a = quarters(v0), b = quarters(v1), c = quarters(v2), d = quarters(v3);
    return (real4)(a.x, b.x, c.x, d.x) + (real4)(a.y, b.y, c.y, d.y) + (real4)(a.z, b.z, c.z, d.z) +
           (real4)(a.w, b.w, c.w, d.w);
}

static inline uint bits_of(MASKR bits) {
#if ROWS == 8
    const mask4 b4 = bits.lo | bits.hi;
#else
    const mask4 b4 = bits;
#endif
    return b4.x | b4.y | b4.z | b4.w;
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

// Pixel centres in each column and in each row of blocks, relative to the tile's corner.
typedef struct {
    REALV x[COLUMNS], y[ROWS];
#if RAYS == 2
    REALV rays[BLOCKS][3]; // directions of the pixels' rays
#endif
} Grid;

static inline Grid pixel_grid(void) {
    Grid grid;
    for (int i = 0; i < COLUMNS; ++i)
        grid.x[i] = PIXEL_X + 4 * i;
    for (int i = 0; i < ROWS; ++i)
        grid.y[i] = PIXEL_Y + BLOCK_ROWS * i;
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

// The tile's corner as seen from a splat, px.
typedef struct {
    real x, y;
} Corner;

static inline Corner corner_from(const Splat *s, int x0, int y0) {
#if RAYS == 2
    const Corner corner = {0, 0};
#else
    const Corner corner = {x0 - s->x, y0 - s->y};
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
    o.dx = grid->x[b % COLUMNS] + corner.x;
    o.dy = grid->y[b / COLUMNS] + corner.y;
#if RAYS
    o.along = 1;
#endif
#endif
    return o;
}

// The blocks of the tile with corner (x0, y0) whose pixel centres the splat's ellipse meets, as bits.
static inline uint blocks_met(const Splat *s, int x0, int y0) {
#if RAYS
    const Outline *e = &s->outline;
    const real inv_half_height = e->inv_half_height, slope = e->slope, half_sq = e->half_sq;
#else
    const Splat *e = s;
    const real inv_a = 1 / s->a, inv_half_height = 1 / s->half_height, slope = (real)-0.5 * s->b * inv_a;
    const real half_sq = ((real)(LOG2_ALPHA_MIN - LOG2_E * EXTENT_SLACK) - s->level) * inv_a;
#endif
    const ROWV top = BLOCK_ROWS * ROW + (y0 + (real)0.5 - e->y), bottom = top + (BLOCK_ROWS - 1), zero = 0;
    const ROWV at_left = CLAMP((ROWV)-e->at_right, top, bottom), at_right = CLAMP((ROWV)e->at_right, top, bottom);
    const ROWV t_left = at_left * inv_half_height, t_right = at_right * inv_half_height;
    const ROWV rest_left = 1 - t_left * t_left, rest_right = 1 - t_right * t_right;
    const ROWV sq_left = half_sq * GREATER(rest_left, zero), sq_right = half_sq * GREATER(rest_right, zero);
    const ROWV x_min = e->x - x0 + slope * at_left - OF_ROWS(sqrt, sq_left);
    const ROWV x_max = e->x - x0 + slope * at_right + OF_ROWS(sqrt, sq_right);
    const MASKR met = (top <= (ROWV)e->half_height) & (bottom >= (ROWV)-e->half_height) & (x_min <= x_max);
    MASKR bits = 0;
    _Pragma("unroll") for (int i = 0; i < COLUMNS; ++i) bits |=
        (x_min <= (ROWV)(4 * i + (real)3.5)) & (x_max >= (ROWV)(4 * i + (real)0.5)) & (FIRST_BIT << i);
    return bits_of(bits & met);
}

#if LANES == 16
DEFINE_POWER(16)
#define POWERV power16
#else
DEFINE_POWER(8)
#define POWERV power8
#endif

// Removes the next block from a set. Counting zeros in one instruction makes compositing a tenth faster. OpenCL C 1.2
// has no function for it, and Oclgrind 21.10, which is based on Clang, cannot run the built-in (-DWITHOUT_CTZ).
static inline uint take_block(uint *blocks) {
#if defined(__clang__) && !defined(WITHOUT_CTZ)
    const uint next = __builtin_ctz(*blocks);
#else
    // The exponent of the lowest power of two in it.
    const uint next = (as_uint((float)(*blocks & -*blocks)) >> 23) - 127;
#endif
    *blocks &= *blocks - 1;
    return next;
}

// Bit b is set while block b has an unfinished pixel.
static inline uint unfinished_blocks(const REALV *transmittance) {
    uint blocks = 0;
    for (int b = 0; b < BLOCKS; ++b)
        blocks |= any_lane(transmittance[b] > 0) ? 1u << b : 0;
    return blocks;
}

// A splat and the blocks of the tile that it meets.
typedef struct {
    Splat splat;
    uint blocks;
} Over;

// Number of splats whose blocks are found before the first of them is composited. A processor cannot predict the end
// of the loop over blocks; if the bits are available early, it knows the end early. Finished blocks are searched
// between batches, which costs about as much as one splat.
#define BATCH 32

// Prefetches memory to read or to write. Splats and records have random addresses, and a load that misses the nearest
// caches takes as long as a block. Only for kernels on the host's processor, where addresses are ordinary pointers.
#if defined(__clang__) && (defined(__x86_64__) || defined(__aarch64__))
#define FETCH_TO_READ(p)  __builtin_prefetch((const void *)(size_t)(p))
#define FETCH_TO_WRITE(p) __builtin_prefetch((const void *)(size_t)(p), 1)
#else
#define FETCH_TO_READ(p)
#define FETCH_TO_WRITE(p)
#endif

// Loads up to BATCH splats, beginning with the entry `first` of the list. Returns their number.
static inline uint load_batch(const __global Splat *splats, const __global uint *gauss_ids, uint first, uint end,
                              int x0, int y0, Over *batch) {
    const uint count = LESSER((uint)BATCH, end - first);
    // All loads come first, so that cache misses overlap.
    for (uint j = 0; j < count; ++j)
        batch[j].splat = splats[gauss_ids[first + j]];
    for (uint j = first + BATCH; j < LESSER(end, first + 2 * BATCH); ++j) {
        // Most of them span two cache lines.
        FETCH_TO_READ(&splats[gauss_ids[j]]);
        FETCH_TO_READ(&splats[gauss_ids[j]].color[CHANNELS - 1]);
    }
    for (uint j = 0; j < count; ++j)
        batch[j].blocks = blocks_met(&batch[j].splat, x0, y0);
    return count;
}

// Transmittance 1 inside the image. Pixels outside count as finished.
static inline REALV transmittance_at_first(const Grid *grid, int b, int rows, int columns) {
    const MASKV inside = (grid->x[b % COLUMNS] < (REALV)columns) & (grid->y[b / COLUMNS] < (REALV)rows);
    return inside ? (REALV)1 : (REALV)-1;
}

// Composites the entries [begin, end) of a tile's list over its blocks, and adds the colours to `sums`. A pixel is
// finished where the transmittance would fall to `stop` or below.
static inline void composite_tile(const Grid *grid, const __global Splat *splats, const __global uint *gauss_ids,
                                  uint begin, uint end, int x0, int y0, real stop, REALV *transmittance,
                                  REALV (*sums)[CHANNELS]) {
    Over batch[BATCH];
    for (uint first = begin; first < end; first += BATCH) {
        const uint unfinished = unfinished_blocks(transmittance);
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, x0, y0, batch);
        for (uint j = 0; j < count; ++j) {
            const Splat *s = &batch[j].splat;
            const Corner corner = corner_from(s, x0, y0);
            for (uint blocks = unfinished & batch[j].blocks; blocks;) {
                const uint b = take_block(&blocks);
                const Offset o = offset_in(grid, b, s, corner);
                Bend bend;
                const REALV t = splat_exponent(s, &o, &bend);
                REALV alpha = POWERV(t);
                MASKV live;
                const REALV weight = splat_over(splat_seen(s, t), stop, &alpha, &live, &transmittance[b]);
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) sums[b][k] += weight * s->color[k];
            }
        }
    }
}

#endif
