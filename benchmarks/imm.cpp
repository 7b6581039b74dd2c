// The practical limit: the IMM with two modes, hand-written for one size, lanes last.
//
// A lane is a run; every inner loop goes over LANES of them, one group of the BLOCK after the other,
// so that a group's state stays in the first-level cache over all steps of a span. Sizes and the
// structural zeros of F and H are known when this is compiled. Two algebras:
//
//   textbook  mixing by sums of P_i + d d', F P F' + Q, Joseph's form, exp and log of the C library
//   ours      that of hybridtrack/estimators/_bank.py: Gaussians merged in pairs, F P F' as one
//             sparse product, measured rows scaled by r/s one measurement at a time, modes weighed
//             by sqrt(1/S) with a polynomial exp and no logarithm
//
// Both work on packed lower triangles. Missing measurements are left out (-ffast-math has no NaN).
// States are (position, velocity, acceleration) per axis, positions are measured; the first mode
// has no acceleration. filters.py checks that the model is of this form.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

namespace {

constexpr int BLOCK = 256;
constexpr int MODES = 2;
using Row = double[LANES];

template <class Body, int... I>
inline __attribute__((always_inline)) void unrolled(Body body, std::integer_sequence<int, I...>) {
    (body(std::integral_constant<int, I>{}), ...);
}

// body(0), body(1), ... body(N - 1) with the index known to the compiler
template <int N, class Body>
inline __attribute__((always_inline)) void each(Body body) {
    unrolled(body, std::make_integer_sequence<int, N>{});
}

constexpr int packed(int a, int c) { return a >= c ? a * (a + 1) / 2 + c : c * (c + 1) / 2 + a; }

// Structural non-zeros of F in the given mode.
constexpr bool moves(int mode, int a, int e) {
    return a / 3 == e / 3 && e >= a && !(mode == 0 && e % 3 == 2);
}

constexpr bool needed(int mode, int a, int g) {
    for (int c = 0; c <= a; c++)
        if (moves(mode, c, g)) return true;
    return false;
}

template <int NX, int NY>
struct Model {
    double F[MODES][NX][NX];
    double Q[MODES][NX * (NX + 1) / 2];
    double R[NY];
    double transition[MODES][MODES];
};

template <int NX>
struct State {
    static constexpr int NP = NX * (NX + 1) / 2;
    Row mean[MODES][NX];
    Row covariance[MODES][NP];
    Row probability[MODES];
};

template <int NX>
struct Mixed {
    Row mean[MODES][NX];
    Row covariance[MODES][NX * (NX + 1) / 2];
    Row predicted[MODES];
    Row density[MODES];
    Row exponent[MODES];
};

// ---- what both share -----------------------------------------------------------------------

template <int NX>
void combine(const State<NX>& state, double* __restrict mean, double* __restrict probability) {
    for (int e = 0; e < NX; e++)
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++)
            mean[e * BLOCK + b] = state.probability[0][b] * state.mean[0][e][b] +
                                  state.probability[1][b] * state.mean[1][e][b];
    for (int j = 0; j < MODES; j++)
        std::memcpy(probability + j * BLOCK, state.probability[j], sizeof(Row));
}

// ---- textbook ------------------------------------------------------------------------------

namespace textbook {

// x <- F x, P <- F P F' + Q from the mixed start of mode J
template <int J, int NX, int NY>
void predict(State<NX>& state, const Mixed<NX>& mixed, const Model<NX, NY>& model) {
    auto& F = model.F[J];
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        each<NX>([&](auto a) {
            double x = 0.0;
            each<NX>([&](auto e) {
                if constexpr (moves(J, a, e)) x += F[a][e] * mixed.mean[J][e][b];
            });
            state.mean[J][a][b] = x;
        });
    }
    each<NX>([&](auto a) {
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            double row[NX] = {};
            each<NX>([&](auto g) {
                if constexpr (needed(J, a, g))
                    each<NX>([&](auto e) {
                        if constexpr (moves(J, a, e))
                            row[g] += F[a][e] * mixed.covariance[J][packed(e, g)][b];
                    });
            });
            each<a + 1>([&](auto c) {
                double p = model.Q[J][packed(a, c)];
                each<NX>([&](auto g) {
                    if constexpr (moves(J, c, g)) p += F[c][g] * row[g];
                });
                state.covariance[J][packed(a, c)][b] = p;
            });
        }
    });
}

template <int NX, int NY>
void mix(const State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model) {
    each<MODES>([&](auto j) {
        Row weight[MODES];
        const double p0 = model.transition[0][j], p1 = model.transition[1][j];
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            const double w0 = p0 * state.probability[0][b], w1 = p1 * state.probability[1][b];
            mixed.predicted[j][b] = w0 + w1;
            weight[0][b] = w0 / (w0 + w1);
            weight[1][b] = w1 / (w0 + w1);
        }
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            double d[MODES][NX];
            each<NX>([&](auto e) {
                const double x0 = state.mean[0][e][b], x1 = state.mean[1][e][b];
                const double x = weight[0][b] * x0 + weight[1][b] * x1;
                mixed.mean[j][e][b] = x;
                d[0][e] = x0 - x;
                d[1][e] = x1 - x;
            });
            each<NX>([&](auto a) {
                each<a + 1>([&](auto c) {
                    double p = 0.0;
                    each<MODES>([&](auto i) {
                        p += weight[i][b] *
                             (state.covariance[i][packed(a, c)][b] + d[i][a] * d[i][c]);
                    });
                    mixed.covariance[j][packed(a, c)][b] = p;
                });
            });
        }
    });
}

// P <- (I - K H) P (I - K H)' + K R K'; leaves the squared innovation and det S
template <int J, int NX, int NY>
void update(State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model,
            const double* __restrict y) {
    auto& P = state.covariance[J];
    Row squared, determinant;
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        double K[NX][NY], innovation[NY], inverse[NY][NY];
        each<NY>([&](auto m) { innovation[m] = y[m * BLOCK + b] - state.mean[J][3 * m][b]; });
        if constexpr (NY == 1) {
            const double s = P[0][b] + model.R[0];
            determinant[b] = s;
            inverse[0][0] = 1.0 / s;
        } else {
            const double s00 = P[packed(0, 0)][b] + model.R[0], s01 = P[packed(3, 0)][b];
            const double s11 = P[packed(3, 3)][b] + model.R[1];
            determinant[b] = s00 * s11 - s01 * s01;
            const double scale = 1.0 / determinant[b];
            inverse[0][0] = scale * s11;
            inverse[1][1] = scale * s00;
            inverse[0][1] = inverse[1][0] = -scale * s01;
        }
        double d2 = 0.0;
        each<NY>([&](auto m) {
            each<NY>([&](auto n) { d2 += innovation[m] * inverse[m][n] * innovation[n]; });
        });
        squared[b] = d2;
        each<NX>([&](auto a) {
            each<NY>([&](auto m) {
                K[a][m] = 0.0;
                each<NY>([&](auto n) { K[a][m] += P[packed(a, 3 * n)][b] * inverse[n][m]; });
            });
        });
        each<NX>([&](auto a) {
            each<NY>([&](auto m) { state.mean[J][a][b] += K[a][m] * innovation[m]; });
        });
        double measured[NY][NX];  // rows of P before they are overwritten
        each<NY>([&](auto m) {
            each<NX>([&](auto e) { measured[m][e] = P[packed(e, 3 * m)][b]; });
        });
        each<NX>([&](auto a) {
            double reduced[NY];  // (A P)[a, measured]
            each<NY>([&](auto n) {
                reduced[n] = measured[n][a];
                each<NY>([&](auto m) { reduced[n] -= K[a][m] * measured[m][3 * n]; });
            });
            each<a + 1>([&](auto c) {
                double p = P[packed(a, c)][b];
                each<NY>([&](auto m) {
                    p -= K[a][m] * measured[m][c] + reduced[m] * K[c][m];
                    p += K[a][m] * model.R[m] * K[c][m];
                });
                P[packed(a, c)][b] = p;
            });
        });
    }
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++)
        mixed.exponent[J][b] = -0.5 * (squared[b] + std::log(determinant[b]));
}

template <int NX>
void weigh(State<NX>& state, const Mixed<NX>& mixed) {
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        const double l0 = mixed.exponent[0][b], l1 = mixed.exponent[1][b];
        const double largest = l0 > l1 ? l0 : l1;
        const double w0 = mixed.predicted[0][b] * std::exp(l0 - largest);
        const double w1 = mixed.predicted[1][b] * std::exp(l1 - largest);
        state.probability[0][b] = w0 / (w0 + w1);
        state.probability[1][b] = w1 / (w0 + w1);
    }
}

template <int NX, int NY>
void step(State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model, const double* y) {
    mix(state, mixed, model);
    each<MODES>([&](auto j) {
        predict<j>(state, mixed, model);
        update<j>(state, mixed, model, y);
    });
    weigh(state, mixed);
}

}  // namespace textbook

// ---- ours ----------------------------------------------------------------------------------

namespace ours {

inline double bits(std::int64_t i) {
    double x;
    std::memcpy(&x, &i, 8);
    return x;
}

// As hybridtrack/compiled.py has them. -ffast-math may not undo the reduction: n is an integer.
inline double exp(double x) {
    const double y = x <= -708.0 ? -708.0 : x;
    const double n = std::rint(y * 1.4426950408889634);
    const double r = (y - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    double p = 1.0 / 6227020800.0;
    constexpr double coefficients[] = {
        1.0 / 479001600.0, 1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0,
        1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0};
    each<13>([&](auto i) { p = p * r + coefficients[i]; });
    const std::int64_t exponent = static_cast<std::int64_t>(n) + 1023;
    return x <= -708.0 ? 0.0 : p * bits(exponent << 52);
}

template <int NX, int NY>
void mix(const State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model) {
    each<MODES>([&](auto j) {
        const double p0 = model.transition[0][j], p1 = model.transition[1][j];
        Row share;
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            const double w1 = p1 * state.probability[1][b];
            const double total = p0 * state.probability[0][b] + w1;
            mixed.predicted[j][b] = total;
            share[b] = total > 0.0 ? w1 / total : 0.0;
        }
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            const double s = share[b], rest = 1.0 - s;
            double d[NX];
            each<NX>([&](auto e) {
                d[e] = state.mean[1][e][b] - state.mean[0][e][b];
                mixed.mean[j][e][b] = state.mean[0][e][b] + s * d[e];
            });
            each<NX>([&](auto a) {
                each<a + 1>([&](auto c) {
                    constexpr int t = packed(a, c);
                    mixed.covariance[j][t][b] =
                        rest * (state.covariance[0][t][b] + s * (d[a] * d[c])) +
                        s * state.covariance[1][t][b];
                });
            });
        }
    });
}

// Whether P(e, g) takes part in (F P F')(a, c), e >= g
constexpr bool contributes(int mode, int a, int c, int e, int g) {
    return (moves(mode, a, e) && moves(mode, c, g)) || (moves(mode, a, g) && moves(mode, c, e));
}

// x <- F x, P <- F P F' + Q, each element of P in one sparse sum
// (the mean's loop shared with the textbook's made g++'s code a quarter slower with 6 states)
template <int J, int NX, int NY>
void predict(State<NX>& state, const Mixed<NX>& mixed, const Model<NX, NY>& model) {
    auto& F = model.F[J];
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        each<NX>([&](auto a) {
            double x = 0.0;
            each<NX>([&](auto e) {
                if constexpr (moves(J, a, e)) x += F[a][e] * mixed.mean[J][e][b];
            });
            state.mean[J][a][b] = x;
        });
    }
    each<NX>([&](auto a) {
        each<a + 1>([&](auto c) {
            double weight[NX][NX];
            each<NX>([&](auto e) {
                each<e + 1>([&](auto g) {
                    weight[e][g] = F[a][e] * F[c][g] + (e != g ? F[a][g] * F[c][e] : 0.0);
                });
            });
#pragma GCC ivdep
            for (int b = 0; b < LANES; b++) {
                double p = model.Q[J][packed(a, c)];
                each<NX>([&](auto e) {
                    each<e + 1>([&](auto g) {
                        if constexpr (contributes(J, a, c, e, g))
                            p += weight[e][g] * mixed.covariance[J][packed(e, g)][b];
                    });
                });
                state.covariance[J][packed(a, c)][b] = p;
            }
        });
    });
}

template <int J, int NX, int NY>
void update(State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model,
            const double* __restrict y) {
    auto& P = state.covariance[J];
    Row squared, precision;
    each<NY>([&](auto m) {
        constexpr int p = 3 * m;
        const double variance = model.R[m];
#pragma GCC ivdep
        for (int b = 0; b < LANES; b++) {
            const double inverse = 1.0 / (P[packed(p, p)][b] + variance);
            const double innovation = y[m * BLOCK + b] - state.mean[J][p][b];
            const double d2 = innovation * innovation * inverse;
            squared[b] = m == 0 ? d2 : squared[b] + d2;
            precision[b] = m == 0 ? inverse : precision[b] * inverse;
            double row[NX];
            each<NX>([&](auto e) {
                row[e] = P[packed(e, p)][b];
                state.mean[J][e][b] += row[e] * inverse * innovation;
            });
            const double kept = variance * inverse;
            each<NX>([&](auto a) {
                each<a + 1>([&](auto c) {
                    if constexpr (a == p || c == p)
                        P[packed(a, c)][b] *= kept;
                    else
                        P[packed(a, c)][b] -= row[a] * inverse * row[c];
                });
            });
        }
    });
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        mixed.density[J][b] = std::sqrt(precision[b]);
        mixed.exponent[J][b] = -0.5 * squared[b];
    }
}

template <int NX>
void weigh(State<NX>& state, const Mixed<NX>& mixed) {
#pragma GCC ivdep
    for (int b = 0; b < LANES; b++) {
        const double l0 = mixed.exponent[0][b], l1 = mixed.exponent[1][b];
        const double largest = l0 > l1 ? l0 : l1;
        const double w0 = mixed.density[0][b] * mixed.predicted[0][b] * exp(l0 - largest);
        const double w1 = mixed.density[1][b] * mixed.predicted[1][b] * exp(l1 - largest);
        const double inverse = 1.0 / (w0 + w1);
        state.probability[0][b] = w0 * inverse;
        state.probability[1][b] = w1 * inverse;
    }
}

template <int NX, int NY>
void step(State<NX>& state, Mixed<NX>& mixed, const Model<NX, NY>& model, const double* y) {
    mix(state, mixed, model);
    each<MODES>([&](auto j) {
        predict<j>(state, mixed, model);
        update<j>(state, mixed, model, y);
    });
    weigh(state, mixed);
}

}  // namespace ours

}  // namespace

// Several steps, one group of lanes after the other: y (n_steps, NY, BLOCK); mean (n_steps, NX,
// BLOCK), probability (n_steps, 2, BLOCK).
#define ADVANCE(ALGEBRA, NX, NY)                                                               \
    extern "C" void advance_##ALGEBRA##_##NX##_##NY(                                           \
        int n_steps, void* states, void* mixed, const void* model, const double* y,            \
        double* mean, double* probability) {                                                   \
        for (int g = 0; g < BLOCK / LANES; g++) {                                              \
            auto& s = static_cast<State<NX>*>(states)[g];                                      \
            for (int k = 0; k < n_steps; k++) {                                                \
                ALGEBRA::step<NX, NY>(s, *static_cast<Mixed<NX>*>(mixed),                      \
                                      *static_cast<const Model<NX, NY>*>(model),               \
                                      y + k * NY * BLOCK + g * LANES);                         \
                combine(s, mean + k * NX * BLOCK + g * LANES,                                  \
                        probability + k * MODES * BLOCK + g * LANES);                          \
            }                                                                                  \
        }                                                                                      \
    }

ADVANCE(textbook, 3, 1)
ADVANCE(textbook, 6, 2)
ADVANCE(ours, 3, 1)
ADVANCE(ours, 6, 2)
