// Real spherical harmonics up to degree 3 in the sign convention of the 3D Gaussian Splatting files
// (Condon-Shortley phase included; Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A2).
#ifndef CLSPLAT_SH_H
#define CLSPLAT_SH_H

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
static inline void sh_basis(real3 d, int degree, real *basis) {
    const real x = d.x, y = d.y, z = d.z;
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
static inline real3 sh_basis_vjp(real3 d, int degree, const real *v) {
    const real x = d.x, y = d.y, z = d.z;
    real3 v_d = 0;
    if (degree > 0) {
        v_d += SH_C1 * (real3)(-v[3], -v[1], v[2]);
    }
    if (degree > 1) {
        v_d += SH_C2A * (real3)(y * v[4] - z * v[7], x * v[4] - z * v[5], -y * v[5] - x * v[7]);
        v_d += 2 * SH_C2B * v[6] * (real3)(-x, -y, 2 * z);
        v_d += 2 * SH_C2C * v[8] * (real3)(x, -y, 0);
    }
    if (degree > 2) {
        v_d += 3 * SH_C3A * v[9] * (real3)(-2 * x * y, y * y - x * x, 0);
        v_d += SH_C3B * v[10] * (real3)(y * z, x * z, x * y);
        v_d += SH_C3C * v[11] * (real3)(2 * x * y, x * x + 3 * y * y - 4 * z * z, -8 * y * z);
        v_d += 3 * SH_C3D * v[12] * (real3)(-2 * x * z, -2 * y * z, 2 * z * z - x * x - y * y);
        v_d += SH_C3C * v[13] * (real3)(3 * x * x + y * y - 4 * z * z, 2 * x * y, -8 * x * z);
        v_d += SH_C3E * v[14] * (real3)(2 * x * z, -2 * y * z, x * x - y * y);
        v_d += 3 * SH_C3A * v[15] * (real3)(y * y - x * x, 2 * x * y, 0);
    }
    return v_d;
}

#endif
