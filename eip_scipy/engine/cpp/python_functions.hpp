// A user's functions in Python, called with arrays of their own, as SciPy calls them.
#pragma once

#include "arrays.hpp"

#include <optional>
#include <vector>

#include "records.hpp"

namespace eip {

// The largest number of further arguments of a function.
constexpr int MOST_ARGUMENTS = 8;

// One function: fun(t, y[, f][, out], *args). Its value is used as it is if it is a float or an array of the right
// kind. Otherwise `convert(value, t)` converts it, or raises an error.
class PythonCall {
  public:
    // `description` has the attributes fun, args, convert, shape (of the value: () for a number), takes_f, in_place.
    PythonCall(nb::handle description, int type, int64_t components, nb::list &kept);

    // y has `components` of the state's type; f too, where the function takes it. `owner`: what `out` belongs to. The
    // function receives the time t as an np.float64, or as the `time` that is given.
    void operator()(double t, const double *y, const double *f, double *out, nb::handle owner,
                    nb::handle time = {}) const;

    int64_t floats() const { return floats_; }

  private:
    bool by_pointer(double t, const double *y, const double *f, double *out) const;
    bool take_list(PyObject *value, double *out) const;
    void take(PyObject *value, PyObject *t, double *out) const;

    nb::handle fun_, convert_;
    uintptr_t pointer_ = 0;  // of a `GradientPointer` if it takes f, else of a `ValuePointer`
    bool pointer_takes_f_ = false;
    const double *params_ = nullptr;
    mutable std::vector<double>
        states_[2];  // copies of y and f for `pointer_`, because the function may overwrite them
    std::vector<nb::handle> args_;
    npy_intp dimensions_[2];
    int n_dimensions_, type_, value_type_;
    int64_t components_, floats_;
    bool takes_f_, in_place_;
};

// The functions of a run.
class PythonFunctions final : public CalledFunctions {
  public:
    // `functions` has rhs, sequences inv, grad and event, and the rates of balances; `owner` is what all memory that functions
    // in place fill belongs to.
    PythonFunctions(nb::handle functions, nb::handle owner, const Work &sizes, int type, nb::list &kept);

    void rhs(double t, const double *y, double *out) override;
    void jacobian(double t, const double *q, const double *dq, double *out) override;
    void all(Functions kind, double t, const double *y, const double *f, double *out) override;
    void gradients(double t, const double *y, const double *f, double *G, const FromF &known) override;
    void one(Functions kind, int64_t k, double t, const double *y, const double *f, double *out) override;
    bool has_jacobian() const { return jacobian_.has_value(); }
    int64_t events() const { return std::ssize(calls_[EVENTS]); }

    // Adds an owner of memory that functions in place fill as well.
    void add_owner(nb::handle owner, nb::list &kept);

  private:
    std::optional<PythonCall> rhs_, jacobian_;
    std::vector<std::optional<PythonCall>> calls_[N_FUNCTIONS];  // none for a balance without a rate of its own
    nb::handle owner_;
    int64_t m_;
    bool second_order_;
};

// Parts of a step in Python, see `Hooks` in native.py.
class PythonHooks final : public Hooks {
  public:
    PythonHooks(nb::handle hooks, const Buffers &buffers, const Run &run, nb::list &kept);

    int drive(double t, const double *y, bool again, double *clock) override;
    int raw_step(const Step &step) override;
    bool project_jointly(const Step &step) override;

    // Sets the array to which the next steps write their states.
    void set_state(nb::handle to) { to_ = to; }

  private:
    Run run_;
    int type_;
    nb::handle to_, one_step_, moments_, shift_, y_hat_, f_hat_, values_, R_, terms_, mu_;
    bool estimates_ = false;
};

}  // namespace eip
