/* A step of the scaled gradient projection method, inside the transforms along the rows. */

/* D = (f + z) a / (1 + mu (f + z) a): a split gradient's own scaling, shifted by z. */
INLINE vec scaling(const vec f, const vec shift, const vec weight, const real mu)
{
    const vec scaled = (f + shift) * weight;
#if HAS_MU
    return scaled / (1 + mu * scaled);
#else
    return scaled;
#endif
}

/* y = gradient' - gradient, and its share of the sums <D y, s> and <D y, D y>. */
INLINE vec next_gradient(
    const vec gradient, const vec correction, const vec f, const vec previous, const vec d,
    const real mu, vec *change_step, vec *change_change)
{
#if HAS_MU
    const vec next = mu * f - correction;
#else
    const vec next = -correction;
#endif
    const vec change = d * (next - gradient);
    *change_step += change * (f - previous);
    *change_change += change * change;
    return next;
}

/* gradient' = mu f - c, c = sum_j A_j^T (r_j - w_j); previous' = f;
 * sums: <D y, s> and <D y, D y>, y = gradient' - gradient, s = f - previous, with the scaling
 * D = (f + shift) a / (1 + mu (f + shift) a), a = 1 / sum_j A_j^T w_j.
 * spectra: one array, const, row spectrum of c. extended (f), shift: one array of pixels each,
 * const; gradient, previous: one each, updated. inverse_weight: one array of pixels, a
 * (HAS_WEIGHTS; where there are none a = 1 / N_IMAGES). sums: [ROW_BLOCKS][2][2].
 * Launch: up to ROW_BLOCKS groups. In place. Scratch: NX points. Twin: reference.gradient_rows.
 */
KERNEL void gradient_rows(
    __global const vec *restrict spectra, __global real *restrict sums,
    __global vec *restrict gradient, __global vec *restrict previous,
    __global const vec *restrict extended, __global const vec *restrict shift,
    __global const vec *restrict inverse_weight, const real mu,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    SCRATCH vec *z = OWN_SCRATCH(scratch, NX);
    FOR_EACH_BLOCK(block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        read_tiles(z, spectra, block);
        dit_inner(z, NX, row_roots);
        vec_sum change_step = {0, 0}, change_change = {0, 0};
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[8];
            load_inverse(a, z + lane, x, NX, row_roots);
            vec step_part = 0, change_part = 0;
            /* Left rolled: unrolled, the pixelwise work runs out of registers and is slower. */
            for (int q = 0; q < OUTER(NX); ++q) {
                const int pixel = q * INNER(NX) + x;
                const cvec f = LOAD(extended + at + lane, pixel);
                const cvec before = LOAD(previous + at + lane, pixel);
                const cvec seen = LOAD(shift + at + lane, pixel);
                cvec g = LOAD(gradient + at + lane, pixel);
                const cvec weight = inverse_weight_at(inverse_weight + at + lane, pixel);
                g.re = next_gradient(
                    g.re, a[q].re, f.re, before.re, scaling(f.re, seen.re, weight.re, mu), mu,
                    &step_part, &change_part);
                g.im = next_gradient(
                    g.im, a[q].im, f.im, before.im, scaling(f.im, seen.im, weight.im, mu), mu,
                    &step_part, &change_part);
                STORE(gradient + at + lane, pixel, g);
                STORE(previous + at + lane, pixel, f);
            }
            ACCUMULATE(change_step, step_part);
            ACCUMULATE(change_change, change_part);
        }
        store_pair(sums + 4 * block, sum_group(sum_lanes(change_step), shared));
        store_pair(sums + 4 * block + 2, sum_group(sum_lanes(change_change), shared));
        BARRIER;
    }
}

/* d = P(f - alpha D gradient) - f, P the projection on f >= 0; extended = f + share d;
 * spectra <- row spectrum of extended; sums: <gradient, d> and <reach_s, d>;
 * squares: sum extended^2. D as in gradient_rows.
 * spectra: one array, out: twice the row spectrum. extended: one array of pixels, written.
 * previous (f), gradient, shift: one each, const. inverse_weight: as in gradient_rows.
 * reach: N_STARS arrays of pixels. sums: [ROW_BLOCKS][N_SUMS][2]; squares: [ROW_BLOCKS][2] (HAS_MU).
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.step_rows.
 */
KERNEL void step_rows(
    __global vec *restrict spectra, __global vec *restrict extended,
    __global real *restrict sums, __global real *restrict squares,
    __global const vec *restrict previous, __global const vec *restrict gradient,
    __global const vec *restrict shift, __global const vec *restrict inverse_weight,
    __global const vec *restrict reach, const real mu, const real alpha, const real share,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    SCRATCH vec *z = OWN_SCRATCH(scratch, NX);
    FOR_EACH_BLOCK(block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        vec_sum totals[N_SUMS], square_total = {0, 0};
        for (int i = 0; i < N_SUMS; ++i)
            totals[i] = (vec_sum){0, 0};
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[8];
            vec parts[N_SUMS], square_part = 0;
            for (int i = 0; i < N_SUMS; ++i)
                parts[i] = 0;
            for (int q = 0; q < OUTER(NX); ++q) {
                const int pixel = q * INNER(NX) + x;
                const cvec f = LOAD(previous + at + lane, pixel);
                const cvec g = LOAD(gradient + at + lane, pixel);
                const cvec seen = LOAD(shift + at + lane, pixel);
                const cvec weight = inverse_weight_at(inverse_weight + at + lane, pixel);
                const cvec d = {
                    not_below_0(f.re - alpha * scaling(f.re, seen.re, weight.re, mu) * g.re) - f.re,
                    not_below_0(f.im - alpha * scaling(f.im, seen.im, weight.im, mu) * g.im) - f.im
                };
                parts[0] += g.re * d.re + g.im * d.im;
                for (int s = 0; s < N_STARS; ++s) {
                    const cvec r = LOAD(reach + (size_t)s * PIXELS_SIZE + at + lane, pixel);
                    parts[1 + s] += r.re * d.re + r.im * d.im;
                }
                /* f + d is not below 0 but for rounding. */
                a[q].re = not_below_0(f.re + share * d.re);
                a[q].im = not_below_0(f.im + share * d.im);
#if HAS_MU
                square_part += a[q].re * a[q].re + a[q].im * a[q].im;
#endif
                STORE(extended + at + lane, pixel, a[q]);
            }
            for (int i = 0; i < N_SUMS; ++i)
                ACCUMULATE(totals[i], parts[i]);
#if HAS_MU
            ACCUMULATE(square_total, square_part);
#endif
            store_forward(z + lane, a, x, NX, row_roots);
        }
        for (int i = 0; i < N_SUMS; ++i)
            store_pair(sums + 2 * (N_SUMS * block + i), sum_group(sum_lanes(totals[i]), shared));
#if HAS_MU
        store_pair(squares + 2 * block, sum_group(sum_lanes(square_total), shared));
#endif
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(spectra, z, block);
    }
}
