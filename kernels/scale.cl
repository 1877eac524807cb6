/* The SGM scalings, inside the transforms along the rows. */

INLINE vec not_below_0(const vec x)
{
    return x < 0 ? (vec)0 : x;
}

/* Scales the points of a butterfly, 0, INNER(NX), ... from the pointers on, whose corrections c a[] has,
 * in place; their sum of f^2. It is called with a literal is_smoothed, and mu 0: branches in the loop
 * would leave a[] in memory.
 */
INLINE vec scale_points(
    cvec *a, __global vec *extended, __global const vec *inverse_weight, __global const vec *slope,
    __global const vec *curvature, const int has_weights, const int is_smoothed, const real mu)
{
    vec squares = 0;
    UNROLL_IN_GROUPS
    for (int q = 0; q < OUTER(NX); ++q) {
        const int pixel = q * INNER(NX);
        const cvec f = LOAD(extended, pixel);
        const cvec weight = LOAD_MAP(inverse_weight, has_weights, pixel);
        const cvec curved = smoothing_at(curvature, pixel, is_smoothed);
        const cvec down = smoothing_at(slope, pixel, is_smoothed);
        a[q].re += curved.re * f.re - down.re;
        a[q].im += curved.im * f.im - down.im;
        a[q].re = f.re * not_below_0(1 + weight.re * a[q].re);
        a[q].im = f.im * not_below_0(1 + weight.im * a[q].im);
        if (is_smoothed || mu != 0) {
            a[q].re /= 1 + (mu + curved.re) * f.re * weight.re;
            a[q].im /= 1 + (mu + curved.im) * f.im * weight.im;
        }
        squares += a[q].re * a[q].re + a[q].im * a[q].im;
        STORE(extended, pixel, a[q]);
    }
    return squares;
}

/* f <- f (1 + a u) / (1 + (mu + curvature) f a), u = c + curvature f - slope,
 * c = sum_j A_j^T (r_j - w_j), a = 1 / sum_j A_j^T w_j, and 1 + a u not below 0, of each sky;
 * spectra <- row spectrum of the new f; square_sums: sum f^2; the stars, with p_s = star_weights_s:
 * c_s <- c_s (p_s star_corrections_s + q_s c0_s) / (p_s + q_s c_s), by the prior (c0_s, q_s).
 * spectra: N_SPECTRA arrays, the first n_skies in: row spectra of c, out: twice the row spectra of f.
 * extended: n_skies arrays of pixels, f. inverse_weight: n_skies arrays of pixels, a (has_weights), or
 * one point, [2][BLOCK], for all. slope, curvature: n_skies arrays of pixels each, const, those of f
 * (is_smoothed; else they count as 0). square_sums: [n_skies][ROW_BLOCKS][2].
 * star_fluxes, star_corrections, star_weights, prior_fluxes, prior_precision: [n_stars].
 * steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups a sky. In place. Scratch: NX points. Twin: reference.scale_rows.
 */
KERNEL void scale_rows(
    __global vec *restrict spectra, __global vec *restrict extended,
    __global real *restrict square_sums, __global real *restrict star_fluxes,
    __global const vec *restrict inverse_weight, __global const real *restrict star_corrections,
    __global const real *restrict star_weights, __global const real *restrict prior_fluxes,
    __global const real *restrict prior_precision, __global const vec *restrict slope,
    __global const vec *restrict curvature, __global const real *restrict steps,
    const int has_weights, const int is_smoothed, const real mu, const int n_stars,
    const int n_images, const int n_skies, __global const real *restrict row_roots,
    SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(extended, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(square_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(slope, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(curvature, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, ROW_BLOCKS * n_skies) {
        __global vec *row_spectra = SPECTRA_OF_SKY(spectra, unit);
        const size_t at = (size_t)unit * NX * 2 * SIDE;
        read_tiles(z, row_spectra, unit % ROW_BLOCKS);
        dit_inner(z, NX, row_roots);
        vec_sum total = {0, 0};
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            vec squares;
            load_inverse(a, OF_LANE(z, lane), x, NX, row_roots);
            __global vec *source = FROM_POINT(extended + at, x, lane);
            __global const vec *weight =
                FROM_POINT(inverse_weight + has_weights * at, x & -has_weights, lane);
            __global const vec *down = FROM_POINT(slope + at, x, lane);
            __global const vec *curved = FROM_POINT(curvature + at, x, lane);
            /* A pass of its own over the pixels takes longer here. */
            if (is_smoothed)
                squares = scale_points(a, source, weight, down, curved, has_weights, 1, mu);
            else if (mu != 0)
                squares = scale_points(a, source, weight, down, curved, has_weights, 0, mu);
            else
                squares = scale_points(a, source, weight, down, curved, has_weights, 0, 0);
            ACCUMULATE(total, squares);
            store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
        }
        store_pair(square_sums + 2 * unit, sum_group(sum_lanes(total), shared));
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(row_spectra, z, unit % ROW_BLOCKS, 1);
    }
    if (get_group_id(0) == 0) {
        OF_MEMBER(star_fluxes, n_stars);
        OF_MEMBER(star_corrections, n_stars);
        OF_MEMBER(prior_fluxes, n_stars);
        FOR_EACH(s, steps[GOING] != 0 ? n_stars : 0) {
            const real flux = star_fluxes[s], known = prior_precision[s] / star_weights[s];
            star_fluxes[s] =
                flux * (star_corrections[s] + known * prior_fluxes[s]) / (1 + known * flux);
        }
    }
}
