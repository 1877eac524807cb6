/* The SGM scalings, inside the transforms along the rows. */

INLINE vec not_below_0(const vec x)
{
    return x < 0 ? (vec)0 : x;
}

/* a = 1 / sum_j A_j^T w_j of a point. */
INLINE cvec inverse_weight_at(
    __global const vec *inverse_weight, const int pixel, const int n_images)
{
#if HAS_WEIGHTS
    return LOAD(inverse_weight, pixel);
#else
    return (cvec){(real)1 / n_images, (real)1 / n_images};
#endif
}

/* f <- f (1 + a u) / (1 + (mu + curvature) f a), u = c + curvature f - slope,
 * c = sum_j A_j^T (r_j - w_j), a = 1 / sum_j A_j^T w_j, and 1 + a u not below 0;
 * spectra <- row spectrum of the new f; square_sums: sum f^2; the stars, with p_s = star_weights_s:
 * c_s <- c_s (p_s star_corrections_s + q_s c0_s) / (p_s + q_s c_s), by the prior (c0_s, q_s).
 * spectra: one array, in: row spectrum of c, out: twice the row spectrum of f.
 * extended: one array of pixels, f. inverse_weight: one array of pixels, a (HAS_WEIGHTS; else
 * a = 1 / n_images). slope, curvature: one array of pixels each, const, those of f
 * (HAS_SMOOTHING; else they count as 0). square_sums: [ROW_BLOCKS][2] (HAS_MU).
 * star_fluxes, star_corrections, star_weights, prior_fluxes, prior_precision: [n_stars].
 * steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. In place. Scratch: NX points. Twin: reference.scale_rows.
 */
KERNEL void scale_rows(
    __global vec *restrict spectra, __global vec *restrict extended,
    __global real *restrict square_sums, __global real *restrict star_fluxes,
    __global const vec *restrict inverse_weight, __global const real *restrict star_corrections,
    __global const real *restrict star_weights, __global const real *restrict prior_fluxes,
    __global const real *restrict prior_precision, __global const vec *restrict slope,
    __global const vec *restrict curvature, __global const real *restrict steps, const real mu,
    const int n_images, const int n_stars, __global const real *restrict row_roots,
    SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    SCRATCH vec *z = OWN_SCRATCH(scratch, NX);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        __global vec *source = extended + at;
        read_tiles(z, spectra, block);
        dit_inner(z, NX, row_roots);
        vec_sum total = {0, 0};
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            load_inverse(a, z + lane, x, NX, row_roots);
            vec part = 0;
            /* A pass of its own over the pixels takes longer here. */
            UNROLL_IN_GROUPS
            for (int q = 0; q < OUTER(NX); ++q) {
                const int pixel = q * INNER(NX) + x;
                const cvec f = LOAD(source + lane, pixel);
                const cvec weight = inverse_weight_at(inverse_weight + at + lane, pixel, n_images);
                const cvec curved = smoothing_at(curvature + at + lane, pixel);
#if HAS_SMOOTHING
                const cvec down = smoothing_at(slope + at + lane, pixel);
                a[q].re += curved.re * f.re - down.re;
                a[q].im += curved.im * f.im - down.im;
#endif
                a[q].re = f.re * not_below_0(1 + weight.re * a[q].re);
                a[q].im = f.im * not_below_0(1 + weight.im * a[q].im);
#if HAS_PENALTY
                a[q].re /= 1 + penalty_weight(mu, curved.re) * f.re * weight.re;
                a[q].im /= 1 + penalty_weight(mu, curved.im) * f.im * weight.im;
#endif
#if HAS_MU
                part += a[q].re * a[q].re + a[q].im * a[q].im;
#endif
                STORE(source + lane, pixel, a[q]);
            }
#if HAS_MU
            ACCUMULATE(total, part);
#endif
            store_forward(z + lane, a, x, NX, row_roots);
        }
#if HAS_MU
        store_pair(square_sums + 2 * block, sum_group(sum_lanes(total), shared));
#endif
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(spectra, z, block, 1);
    }
    if (get_group_id(0) == 0) {
        FOR_EACH(s, steps[GOING] != 0 ? n_stars : 0) {
            const real flux = star_fluxes[s], known = prior_precision[s] / star_weights[s];
            star_fluxes[s] =
                flux * (star_corrections[s] + known * prior_fluxes[s]) / (1 + known * flux);
        }
    }
}
