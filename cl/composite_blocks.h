// Pixels of a tile in blocks of 4x4, and the splats that meet them: what kernels share in which a work-item owns a tile.
//
// A block is one vector; a splat visits only the blocks that its ellipse meets. How are these found, and what is left
// to do in a block?
//   With the tile's blocks as the lanes of a second vector, one evaluation gives the greatest exponent t (composite.h)
//   of the splat within each block, and with it a set of bits; another one t and its derivatives at each block's
//   centre. Around a centre t(u, v) = t_c + tx u + ty v + (a u^2 + b u v + c v^2), whose last part is the same for all
//   blocks of a splat: a block costs two multiplications and additions until it is at its power of two.
#ifndef CLSPLAT_COMPOSITE_BLOCKS_H
#define CLSPLAT_COMPOSITE_BLOCKS_H

#if TILE != 8 && TILE != 16
#error "-DTILE must be 8 or 16: its blocks of 4x4 pixels are a vector of 4 or 16"
#endif
#define REALV real16
#define MASKV mask16
#include "composite.h"
#include "power.h"

// Pixels of a block, in lanes: offsets from its centre, and their products.
#define U  ((real16)(-1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5))
#define V  ((real16)(-1.5, -1.5, -1.5, -1.5, -0.5, -0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5))
#define UU (U * U)
#define UV (U * V)
#define VV (V * V)

// Blocks of a tile, in lanes: centres relative to the tile's corner.
#if TILE == 16
#define BLOCKS  16
#define BLOCKV  real16
#define MASKB   mask16
#define BLOCK_X ((real16)(2, 6, 10, 14, 2, 6, 10, 14, 2, 6, 10, 14, 2, 6, 10, 14))
#define BLOCK_Y ((real16)(2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14))
#else
#define BLOCKS  4
#define BLOCKV  real4
#define MASKB   mask4
#define BLOCK_X ((real4)(2, 6, 2, 6))
#define BLOCK_Y ((real4)(2, 2, 6, 6))
#endif
#define BLOCKS_IN_ROW (TILE / 4)

static inline real4 quarters(real16 v) {
    const real8 half_sums = v.lo + v.hi;
    return half_sums.lo + half_sums.hi;
}

static inline real sum_lanes(real16 v) {
    const real4 a = quarters(v);
    const real2 b = a.lo + a.hi;
    return b.x + b.y;
}

static inline real4 sum_lanes4(real16 v0, real16 v1, real16 v2, real16 v3) {
    const real4 a = quarters(v0), b = quarters(v1), c = quarters(v2), d = quarters(v3);
    return (real4)(a.x, b.x, c.x, d.x) + (real4)(a.y, b.y, c.y, d.y) + (real4)(a.z, b.z, c.z, d.z) +
           (real4)(a.w, b.w, c.w, d.w);
}

// The lanes of a mask as bits.
static inline uint bits_of(MASKB mask) {
#if TILE == 16
    const mask16 bits = mask & (mask16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768);
    const mask8 b8 = bits.lo | bits.hi;
    const mask4 b4 = b8.lo | b8.hi;
#else
    const mask4 b4 = mask & (mask4)(1, 2, 4, 8);
#endif
    return b4.x | b4.y | b4.z | b4.w;
}

static inline bool any_lane(mask16 mask) {
    const mask8 m8 = mask.lo | mask.hi;
    const mask4 m4 = m8.lo | m8.hi;
    return m4.x | m4.y | m4.z | m4.w;
}

// Lane i of a vector that lies in memory.
#define LANE(vector, i) (((const real *)&(vector))[i])

// A splat over the blocks of a tile.
typedef struct {
    Splat splat;
    BLOCKV x, y;      // of each block's centre, from the splat's
    BLOCKV t, tx, ty; // t there and its derivatives
    uint blocks;      // those that the splat's ellipse meets, as bits
} Over;

static inline BLOCKV t_at(const Splat *s, BLOCKV x, BLOCKV y) {
    return x * (s->a * x + s->b * y) + (s->c * y * y + s->level);
}

// Within a block t is greatest at its point nearest to the centre along x or along y: on the nearest column at
// y = -(b/2c) x, on the nearest row at x = -(b/2a) y, as far as the block reaches.
static inline void splat_over_tile(int x0, int y0, Over *over) {
    const Splat *s = &over->splat;
    const BLOCKV x = BLOCK_X + (x0 - s->x), y = BLOCK_Y + (y0 - s->y);
    const BLOCKV tx = 2 * s->a * x + s->b * y, ty = s->b * x + 2 * s->c * y;
    over->x = x;
    over->y = y;
    over->tx = tx;
    over->ty = ty;
    over->t = (real)0.5 * (tx * x + ty * y) + s->level;
    const BLOCKV x_lo = x - (real)1.5, x_hi = x + (real)1.5, y_lo = y - (real)1.5, y_hi = y + (real)1.5;
    const BLOCKV x_near = CLAMP((BLOCKV)0, x_lo, x_hi), y_near = CLAMP((BLOCKV)0, y_lo, y_hi);
    const BLOCKV y_best = (real)-0.5 * s->b / s->c * x_near, x_best = (real)-0.5 * s->b / s->a * y_near;
    const BLOCKV on_column = t_at(s, x_near, CLAMP(y_best, y_lo, y_hi));
    const BLOCKV on_row = t_at(s, CLAMP(x_best, x_lo, x_hi), y_near);
    over->blocks = bits_of(GREATER(on_column, on_row) >= (BLOCKV)(LOG2_ALPHA_MIN - LOG2_E * EXTENT_SLACK));
}

DEFINE_POWER(16)

// t of the splat in block b; `curved` is the part that all blocks share.
static inline REALV block_exponent(const Over *over, int b, REALV curved) {
    return LANE(over->t, b) + (LANE(over->tx, b) * U + (LANE(over->ty, b) * V + curved));
}

static inline REALV curvature(const Splat *s) {
    return s->a * UU + s->b * UV + s->c * VV;
}

// Takes the next of a set of blocks.
static inline int take_block(uint *blocks) {
    const uint lowest = *blocks & -*blocks;
    *blocks ^= lowest;
    // Its number: the exponent of that power of two.
    return (as_int((float)lowest) >> 23) - 127;
}

// Bit b is set while block b has an unfinished pixel.
static inline uint unfinished_blocks(const REALV *transmittance) {
    uint blocks = 0;
    for (int b = 0; b < BLOCKS; ++b)
        blocks |= any_lane(transmittance[b] > 0) ? 1u << b : 0;
    return blocks;
}

// Splats whose blocks are found before any of them is composited: a loop over blocks ends where the processor cannot
// foresee it, and with the bits at hand it learns of that early. Between batches finished blocks are looked for, at
// about the cost of one splat.
#define BATCH 32

// Loads up to BATCH splats from the list's entry `first` on; returns their number.
static inline uint load_batch(const __global Splat *splats, const __global uint *gauss_ids, uint first, uint end,
                              int x0, int y0, Over *batch) {
    const uint count = LESSER((uint)BATCH, end - first);
    // First all loads, so that the caches' misses overlap.
    for (uint j = 0; j < count; ++j)
        batch[j].splat = splats[gauss_ids[first + j]];
    for (uint j = 0; j < count; ++j)
        splat_over_tile(x0, y0, &batch[j]);
    return count;
}

// Transmittance 1 inside the image; what lies outside counts as finished.
static inline REALV transmittance_at_first(int b, int rows, int columns) {
    const REALV x = U + (real)1.5 + 4 * (b % BLOCKS_IN_ROW), y = V + (real)1.5 + 4 * (b / BLOCKS_IN_ROW);
    return ((x < (REALV)columns) & (y < (REALV)rows)) ? (REALV)1 : (REALV)-1;
}

// Composites the entries [begin, end) of a tile's list over its blocks, whose pixels are finished where the transmittance
// would fall to `stop` or below; adds the colours to sums.
static inline void composite_tile(const __global Splat *splats, const __global uint *gauss_ids, uint begin, uint end,
                                  int x0, int y0, real stop, REALV *transmittance, REALV (*sums)[CHANNELS]) {
    Over batch[BATCH];
    for (uint first = begin; first < end; first += BATCH) {
        const uint unfinished = unfinished_blocks(transmittance);
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, x0, y0, batch);
        for (uint j = 0; j < count; ++j) {
            const Over *over = &batch[j];
            const REALV curved = curvature(&over->splat);
            for (uint blocks = unfinished & over->blocks; blocks;) {
                const int b = take_block(&blocks);
                const REALV t = block_exponent(over, b, curved), alpha = power16(t);
                MASKV drawn = splat_seen(&over->splat, t);
                const REALV weight = splat_over(alpha, stop, &drawn, &transmittance[b]);
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) sums[b][k] += weight * over->splat.color[k];
            }
        }
    }
}

#endif
