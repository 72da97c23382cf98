// Real spherical harmonics up to degree 3 in the sign convention of the 3D Gaussian Splatting files
// (Condon-Shortley phase included; Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A2).
#ifndef CLSPLAT_SH_H
#define CLSPLAT_SH_H

#include "linalg.h"

#define SH_C0  0.28209479177387814 // 1/(2 sqrt(pi))
#define SH_C1  0.4886025119029199  // sqrt(3/(4 pi))
#define SH_C2A 1.0925484305920792  // sqrt(15/(4 pi))
#define SH_C2B 0.31539156525252005 // sqrt(5/(16 pi))
#define SH_C2C 0.5462742152960396  // sqrt(15/(16 pi))
#define SH_C3A 0.5900435899266435  // sqrt(35/(32 pi))
#define SH_C3B 2.890611442640554   // sqrt(105/(4 pi))
#define SH_C3C 0.4570457994644658  // sqrt(21/(32 pi))
#define SH_C3D 0.3731763325901154  // sqrt(7/(16 pi))
#define SH_C3E 1.445305721320277   // sqrt(105/(16 pi))

// The (degree + 1)^2 basis functions at the unit vector d.
static inline void sh_basis(reals3 d, int degree, reals *basis) {
    const reals x = d.x, y = d.y, z = d.z;
    basis[0] = SH_C0;
    if (degree > 0) {
        basis[1] = -SH_C1 * y;
        basis[2] = SH_C1 * z;
        basis[3] = -SH_C1 * x;
    }
    if (degree > 1) {
        basis[4] = SH_C2A * x * y;
        basis[5] = -SH_C2A * y * z;
        basis[6] = SH_C2B * (2 * z * z - x * x - y * y);
        basis[7] = -SH_C2A * x * z;
        basis[8] = SH_C2C * (x * x - y * y);
    }
    if (degree > 2) {
        basis[9] = -SH_C3A * y * (3 * x * x - y * y);
        basis[10] = SH_C3B * x * y * z;
        basis[11] = -SH_C3C * y * (4 * z * z - x * x - y * y);
        basis[12] = SH_C3D * z * (2 * z * z - 3 * x * x - 3 * y * y);
        basis[13] = -SH_C3C * x * (4 * z * z - x * x - y * y);
        basis[14] = SH_C3E * z * (x * x - y * y);
        basis[15] = -SH_C3A * x * (x * x - 3 * y * y);
    }
}

// Gradient with respect to the three components of d as independent variables. v holds the gradients of the basis.
static inline reals3 sh_basis_vjp(reals3 d, int degree, const reals *v) {
    const reals x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    reals3 v_d = {0, 0, 0};
    if (degree > 0) {
        v_d.x += -SH_C1 * v[3];
        v_d.y += -SH_C1 * v[1];
        v_d.z += SH_C1 * v[2];
    }
    if (degree > 1) {
        v_d.x += SH_C2A * (y * v[4] - z * v[7]) - 2 * SH_C2B * x * v[6] + 2 * SH_C2C * x * v[8];
        v_d.y += SH_C2A * (x * v[4] - z * v[5]) - 2 * SH_C2B * y * v[6] - 2 * SH_C2C * y * v[8];
        v_d.z += -SH_C2A * (y * v[5] + x * v[7]) + 4 * SH_C2B * z * v[6];
    }
    if (degree > 2) {
        const reals a = 3 * SH_C3A * v[9], b = SH_C3B * v[10], c = SH_C3C * v[11], e = 3 * SH_C3D * v[12];
        const reals f = SH_C3C * v[13], g = SH_C3E * v[14], h = 3 * SH_C3A * v[15];
        v_d.x +=
            -2 * xy * a + yz * b + 2 * xy * c - 2 * xz * e + (3 * xx + yy - 4 * zz) * f + 2 * xz * g + (yy - xx) * h;
        v_d.y +=
            (yy - xx) * a + xz * b + (xx + 3 * yy - 4 * zz) * c - 2 * yz * e + 2 * xy * f - 2 * yz * g + 2 * xy * h;
        v_d.z += xy * b - 8 * yz * c + (2 * zz - xx - yy) * e - 8 * xz * f + (xx - yy) * g;
    }
    return v_d;
}

#endif
