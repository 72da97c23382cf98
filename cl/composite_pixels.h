// Compositing one pixel at a time: the types of composite.h for it, and a pixel as seen from a splat.
#ifndef CLSPLAT_COMPOSITE_PIXELS_H
#define CLSPLAT_COMPOSITE_PIXELS_H

#define REALV             real
#define MASKV             int
#define MINUS_ABSOLUTE(x) (-fabs(x))
#include "composite.h"
#include "power.h"

// The argument of a kernel that reads the directions of the pixels' rays, and one that passes it on.
#if RAYS == 2
#define DIRECTIONS       , const __global real *directions
#define DIRECTIONS_OF(p) load3(directions, p)
#else
#define DIRECTIONS
#define DIRECTIONS_OF(p) ((real3)0)
#endif

// A pixel as seen from a splat; `ray` is the direction of its ray.
static inline Offset offset_of(int2 pixel, real3 ray, const Splat *s) {
#if RAYS == 2
    Offset o;
    o.dx = s->axis0[0] * ray.x + s->axis0[1] * ray.y + s->axis0[2] * ray.z;
    o.dy = s->axis1[0] * ray.x + s->axis1[1] * ray.y + s->axis1[2] * ray.z;
    o.along = s->axis2[0] * ray.x + s->axis2[1] * ray.y + s->axis2[2] * ray.z;
    return o;
#else
    return offset_at(s, pixel.x + (real)0.5 - s->x, pixel.y + (real)0.5 - s->y);
#endif
}

#endif
