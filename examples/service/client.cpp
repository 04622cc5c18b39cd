// A client of `qpavoid serve panda_ball`. apt-get install g++ cppzmq-dev nlohmann-json3-dev
// g++ -std=c++17 -O2 client.cpp -lzmq -o client && ./client tcp://127.0.0.1:5570
#include <cstdio>
#include <nlohmann/json.hpp>
#include <zmq.hpp>
using nlohmann::json;

json ask(zmq::socket_t& socket, json request) {
    request["version"] = 1;
    socket.send(zmq::buffer(json::to_msgpack(request)), zmq::send_flags::none);
    zmq::message_t reply;
    if (!socket.recv(reply)) throw std::runtime_error("no answer within a second: stop the robot");
    json answer = json::from_msgpack(reply.to_string());
    if (answer["type"] == "error") throw std::runtime_error(answer["error"].dump() + answer["text"].dump());
    return answer;
}

int main(int count, char** words) {
    zmq::context_t context;
    zmq::socket_t socket(context, ZMQ_REQ);
    socket.set(zmq::sockopt::rcvtimeo, 1000);
    socket.connect(count > 1 ? words[1] : "tcp://127.0.0.1:5570");
    const json hello = ask(socket, {{"type", "hello"}});
    ask(socket, {{"type", "reset"}});
    std::vector<double> q = hello["q0"];
    const double dt = hello["dt"];
    for (int k = 0; k < 300; ++k) {
        json step = {{"type", "step"}, {"seq", k}, {"q", q}, {"t", k * dt}};
        step["targets"][hello["targets"][0].get<std::string>()]["position"] = {0.31, 0.0006 * k, 0.49};
        step["obstacles"]["ball"] = {{"position", {0.6 - 0.1 * k * dt, 0.0, 0.5}}, {"linear", {-0.1, 0.0, 0.0}}};
        const json command = ask(socket, step);
        for (size_t i = 0; i < q.size(); ++i) q[i] += dt * command["v"][i].get<double>();  // your robot goes here
        if (k == 299) std::printf("%s: %s\n", hello["robot"].dump().c_str(), command["status"].dump().c_str());
    }
}
