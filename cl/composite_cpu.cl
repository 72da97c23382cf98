// Stage composite, variant for CPUs: splats to pixels, front to back, and gradients back.
//
//   image = sum_i colour_i alpha_i T_i + T_end background,  alpha = 1 - T_end   (Kerbl et al. 2023, equation 3)
// A pixel skips pairs with alpha < ALPHA_MIN and stops before T would fall to TRANSMITTANCE_MIN or below.
// composite.h holds the mathematics, composite_gpu.cl the variant for GPUs, clsplat/reference/composite.py
// the twin.
//
// Mapping: one work-item per tile, which keeps the tile's pixels in private memory (they stay in the L1 cache) and
// takes its splats in depth order. A block of 4x4 pixels is one vector; a splat visits only the blocks that its
// ellipse meets. How are these found, and what is left to do in a block?
//   With the tile's blocks as the lanes of a second vector, one evaluation gives the greatest exponent t (composite.h)
//   of the splat within each block, and with it a set of bits; another one t and its derivatives at each block's
//   centre. Around a centre t(u, v) = t_c + tx u + ty v + (a u^2 + b u v + c v^2), whose last part is the same for all
//   blocks of a splat: a block costs two multiplications and additions until it is at its power of two.
//
// How does the backward pass work? It replays the forward pass front to back. With u_i = colour_i . v_image
// and S the part of sum_i u_i alpha_i T_i + T_end (background . v_image - v_alpha) that lies behind splat i,
//   v_alpha_i = T_i u_i - S_i / (1 - alpha_i);
// S starts as image . v_image - T_end v_alpha and loses one term per splat, so nothing is saved but the
// image, and no transmittance is divided back. A splat's sums over the pixels of a tile go, as a record, to its slot
// of the unsorted list, where the records of a splat are neighbours; composite_sum adds them in a fixed order: no
// atomics.
//
// Buffers: N splats as in project.cl, M intersections and T tiles as in bin.cl, C = CHANNELS
//   in   means2d, conics, extents, opacities, colors, as in project.cl; splats[N], the same packed by composite_pack;
//        gauss_ids[M], tile_ranges[T,2], background[C], slots[M]
//   out  image[H,W,C], alpha[H,W]; backward: records[M,6+C], v_means2d[N,2], v_conics[N,3], v_opacities[N],
//        v_colors[N,C]
// -DTILE=8|16   edge of a tile, px
// -DCHANNELS    colour channels, 1 or more
#include "common.h"

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

__kernel void composite_fwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global real *background, __global real *image, __global real *alpha_image) {
    const uint t = get_global_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = t % tiles_x * TILE, y0 = t / tiles_x * TILE;
    const int rows = LESSER(TILE, height - y0), columns = LESSER(TILE, width - x0);

    REALV transmittance[BLOCKS], sums[BLOCKS][CHANNELS];
    for (int b = 0; b < BLOCKS; ++b) {
        transmittance[b] = transmittance_at_first(b, rows, columns);
        _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) sums[b][k] = 0;
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
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
                const REALV weight = splat_over(alpha, &drawn, &transmittance[b]);
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) sums[b][k] += weight * over->splat.color[k];
            }
        }
    }

    for (int r = 0; r < rows; ++r) {
        const size_t first = (size_t)(y0 + r) * width + x0;
        for (int x = 0; x < columns; ++x) {
            const int b = r / 4 * BLOCKS_IN_ROW + x / 4, lane = r % 4 * 4 + x % 4;
            const real left = ABSOLUTE(LANE(transmittance[b], lane));
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) image[CHANNELS * (first + x) + k] =
                LANE(sums[b][k], lane) + left * background[k];
            alpha_image[first + x] = 1 - left;
        }
    }
}

__kernel void composite_bwd(const int width, const int height, const __global Splat *splats,
                            const __global uint *gauss_ids, const __global uint *tile_ranges,
                            const __global uint *slots, const __global real *image, const __global real *alpha_image,
                            const __global real *v_image, const __global real *v_alpha_image,
                            __global real *records) {
    const uint t = get_global_id(0);
    const int tiles_x = (width + TILE - 1) / TILE;
    const int x0 = t % tiles_x * TILE, y0 = t / tiles_x * TILE;
    const int rows = LESSER(TILE, height - y0), columns = LESSER(TILE, width - x0);

    REALV transmittance[BLOCKS], behind[BLOCKS], v_pixels[BLOCKS][CHANNELS];
    for (int b = 0; b < BLOCKS; ++b) {
        transmittance[b] = transmittance_at_first(b, rows, columns);
        behind[b] = 0;
        _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) v_pixels[b][k] = 0;
    }
    for (int r = 0; r < rows; ++r) {
        const size_t first = (size_t)(y0 + r) * width + x0;
        for (int x = 0; x < columns; ++x) {
            const int b = r / 4 * BLOCKS_IN_ROW + x / 4, lane = r % 4 * 4 + x % 4;
            real sum = (alpha_image[first + x] - 1) * v_alpha_image[first + x];
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) {
                const real v = v_image[CHANNELS * (first + x) + k];
                sum += image[CHANNELS * (first + x) + k] * v;
                ((real *)&v_pixels[b][k])[lane] = v;
            }
            ((real *)&behind[b])[lane] = sum;
        }
    }

    const uint begin = tile_ranges[2 * t], end = tile_ranges[2 * t + 1];
    Over batch[BATCH];
    uint first = begin;
    for (; first < end; first += BATCH) {
        const uint unfinished = unfinished_blocks(transmittance);
        if (!unfinished)
            break;
        const uint count = load_batch(splats, gauss_ids, first, end, x0, y0, batch);
        for (uint j = 0; j < count; ++j) {
            const Over *over = &batch[j];
            const Splat *s = &over->splat;
            const REALV curved = curvature(s);
            REALV m = 0, mx = 0, my = 0, mxx = 0, mxy = 0, myy = 0, v_colors[CHANNELS];
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) v_colors[k] = 0;
            for (uint blocks = unfinished & over->blocks; blocks;) {
                const int b = take_block(&blocks);
                const REALV t = block_exponent(over, b, curved), alpha = power16(t);
                MASKV drawn = splat_seen(s, t);
                const REALV weight = splat_over(alpha, &drawn, &transmittance[b]);
                REALV u = 0;
                _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) {
                    u += s->color[k] * v_pixels[b][k];
                    v_colors[k] += weight * v_pixels[b][k];
                }
                // Moments around the splat, of each block as if its pixels lay in its centre.
                const REALV v_sigma = splat_over_vjp(alpha, drawn, weight, u, &behind[b]);
                const REALV x_sigma = LANE(over->x, b) * v_sigma, y_sigma = LANE(over->y, b) * v_sigma;
                m += v_sigma;
                mx += x_sigma;
                my += y_sigma;
                mxx += LANE(over->x, b) * x_sigma;
                mxy += LANE(over->x, b) * y_sigma;
                myy += LANE(over->y, b) * y_sigma;
            }
            // And with their offsets (U, V) from it.
            const REALV sx = mx + U * m, sy = my + V * m;
            const REALV sxx = mxx + U * (mx + sx), sxy = mxy + V * mx + U * sy, syy = myy + V * (my + sy);
            __global real *record = records + (size_t)RECORD * slots[first + j];
            store4(record, 0, sum_lanes4(m, sx, sy, sxx));
#if CHANNELS == 3
            store4(record + 4, 0, sum_lanes4(sxy, syy, v_colors[0], v_colors[1]));
            record[8] = sum_lanes(v_colors[2]);
#else
            record[4] = sum_lanes(sxy);
            record[5] = sum_lanes(syy);
            _Pragma("unroll") for (int k = 0; k < CHANNELS; ++k) record[6 + k] = sum_lanes(v_colors[k]);
#endif
        }
    }
    for (uint i = first; i < end; ++i) {
        for (int k = 0; k < RECORD; ++k)
            records[(size_t)RECORD * slots[i] + k] = 0;
    }
}

#include "composite_splats.h"
